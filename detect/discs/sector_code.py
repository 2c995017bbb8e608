"""Sums by sector, eight at once, in the compiler's own vectors.

Each pixel adds to the sums of its sector, whichever that is: as a loop that is one number after the
other, and each waits for the sum that the pixel before has stored. Here the sums of a sector lie
side by side and are added to as one vector, and neighbouring pixels, which tend to be in the same
sector, add to different copies.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

#: Sums of one sector: of 1, w, w^2, g, w g, r e, r^2 (see `add_by_sector`), and one that is unused.
SUMS = 8
#: Pixels that are worked on at once, and copies of the sums.
PIXELS = 8
COPIES = 4

_I32, _I64, _FLOAT = ir.IntType(32), ir.IntType(64), ir.FloatType()
_INTS = ir.VectorType(_I32, PIXELS)
_FLOATS = ir.VectorType(_FLOAT, PIXELS)


def _operation(define: Callable[..., Any]) -> Any:
    """An operation that compiled code can call: without the first argument of its definition."""
    return intrinsic(define)


@_operation
def add_by_sector(
    _typing: Any,
    fields: Any,
    share: Any,
    by_radius: Any,
    errors: Any,
    sector: Any,
    n: Any,
    contrast: Any,
    sums: Any,
    sectors: Any,
) -> Any:
    """Sums over the pixels of each sector: of 1, w, w^2, g, w g, r e and r^2.

    With the contrast c and a pixel's share w, its derivative by the radius and the residual e, g is
    e + c w, and r is c times the derivative.

    Parameters
    ----------
    fields : float32, contiguous
    share, by_radius : uint64
        Where in it the shares and their derivatives begin.
    errors : float32, contiguous
    sector : uint32, contiguous
        Sector of each pixel.
    n : uint64
        Pixels: a multiple of `PIXELS`.
    contrast : float32
    sums : (COPIES * sectors * SUMS,) float32, contiguous
        What is added to.
    sectors : uint64
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(k: int) -> Any:
            return context.make_array(signature.args[k])(context, builder, args[k]).data

        def place(pointer: Any, at: Any, vector: Any) -> Any:
            return builder.bitcast(builder.gep(pointer, [at]), vector.as_pointer())

        def load(pointer: Any, at: Any, vector: Any) -> Any:
            value = builder.load(place(pointer, at, vector))
            value.align = 4
            return value

        values, residuals, numbers, result = (data(k) for k in (0, 3, 4, 7))
        c = _everywhere(builder, args[6], _FLOATS)
        per_copy = builder.mul(args[8], ir.Constant(_I64, SUMS))
        one = ir.Constant(_FLOATS, [1.0] * PIXELS)
        nothing = ir.Constant(_FLOATS, [0.0] * PIXELS)
        blocks = builder.udiv(args[5], ir.Constant(_I64, PIXELS))
        with cgutils.for_range(builder, blocks, intp=_I64) as loop:
            i = builder.mul(loop.index, ir.Constant(_I64, PIXELS))
            w = load(values, builder.add(args[1], i), _FLOATS)
            r = builder.fmul(c, load(values, builder.add(args[2], i), _FLOATS))
            e = load(residuals, i, _FLOATS)
            g = builder.fadd(e, builder.fmul(c, w))
            product = builder.fmul
            rows = [
                one, w, product(w, w), g, product(w, g), product(r, e), product(r, r), nothing,
            ]  # fmt: skip
            first = builder.shl(
                load(numbers, i, _INTS), ir.Constant(_INTS, [SUMS.bit_length() - 1] * PIXELS)
            )
            for k, row in enumerate(_transposed(builder, rows)):
                own = builder.zext(builder.extract_element(first, ir.Constant(_I32, k)), _I64)
                copy = builder.mul(per_copy, ir.Constant(_I64, k % COPIES))
                at = builder.add(own, copy)
                total = builder.fadd(load(result, at, _FLOATS), row)
                builder.store(total, place(result, at, _FLOATS)).align = 4
        return context.get_dummy_value()

    whole = types.uint64
    result = types.void(fields, whole, whole, errors, sector, whole, types.float32, sums, whole)
    return result, generate


def _everywhere(builder: Any, value: Any, vector: Any) -> Any:
    """A vector of equal numbers."""
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, first, ir.Constant(_INTS, [0] * PIXELS))


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """As many vectors as they are long, rows and columns exchanged: halves by halves."""
    size = len(rows)
    half = size // 2
    while half:
        # Of each pair of rows that are `half` apart, the blocks beside the diagonal change places.
        first = [k if not k & half else k - half + size for k in range(size)]
        second = [k + half if not k & half else k + size for k in range(size)]
        result = list(rows)
        for k in range(size):
            if not k & half:
                for to, order in ((k, first), (k + half, second)):
                    result[to] = builder.shuffle_vector(
                        rows[k], rows[k + half], ir.Constant(_INTS, order)
                    )
        rows = result
        half //= 2
    return rows
