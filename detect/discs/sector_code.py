"""Sums by sector, eight at once, in the compiler's own vectors.

Each pixel adds to the sums of its sector, whichever that is: as a loop that is one number after the
other, and each waits for the sum that the pixel before has stored. Here the sums of a sector lie
side by side and are added to as one vector, and neighbouring pixels, which tend to be in the same
sector, add to different copies.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from detect.vector_code import FLOAT, I32, I64, Code, constant, operation

#: Sums of one sector: of 1, w, w^2, g, w g, r e, r^2 (see `add_by_sector`), and one that is unused.
SUMS = 8
#: Pixels that are worked on at once, and copies of the sums.
PIXELS = 8
COPIES = 4

_INTS = ir.VectorType(I32, PIXELS)
_FLOATS = ir.VectorType(FLOAT, PIXELS)


@operation
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
        code = Code(context, builder, signature, args)
        c = code.everywhere(args[6], _FLOATS)
        per_copy = builder.mul(args[8], code.number(SUMS))
        one, nothing = constant(_FLOATS, 1.0), constant(_FLOATS, 0.0)
        product = builder.fmul
        blocks = builder.udiv(args[5], code.number(PIXELS))
        with cgutils.for_range(builder, blocks, intp=I64) as loop:
            i = builder.mul(loop.index, code.number(PIXELS))
            w = code.load(0, builder.add(args[1], i), _FLOATS)
            r = product(c, code.load(0, builder.add(args[2], i), _FLOATS))
            e = code.load(3, i, _FLOATS)
            g = builder.fadd(e, product(c, w))
            rows = [
                one, w, product(w, w), g, product(w, g), product(r, e), product(r, r), nothing,
            ]  # fmt: skip
            first = builder.shl(code.load(4, i, _INTS), constant(_INTS, SUMS.bit_length() - 1))
            for k, (own, row) in enumerate(zip(code.scattered(first), _transposed(code, rows))):
                copy = builder.mul(per_copy, code.number(k % COPIES))
                at = builder.add(builder.zext(own, I64), copy)
                code.store(7, at, builder.fadd(code.load(7, at, _FLOATS), row))
        return context.get_dummy_value()

    whole = types.uint64
    result = types.void(fields, whole, whole, errors, sector, whole, types.float32, sums, whole)
    return result, generate


def _transposed(code: Code, rows: list[Any]) -> list[Any]:
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
                    result[to] = code.shuffled(rows[k], rows[k + half], order)
        rows = result
        half //= 2
    return rows
