"""Copies of a disc table carried out, and what they gather summed: 64 centres at a time.

These two operations are where the disc detector's time goes, and the only ones that are given to
the compiler as instructions on vectors. As loops the copies are not vectorised, since an image and
what is gathered from it might overlap; and sums and copies take turns here: one keeps a processor's
arithmetic busy, the other its ways to memory. They are called from compiled code only, and check
nothing: see `detect.discs.quality` for what goes in.

Squares are summed by way of a grey value times its complement, x (255 - x): four of these fit into
16 bits, and x^2 = 255 x - x (255 - x).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from lut.kernels import ADVANCE_BITS, AT_ONCE, COPIED, LARGEST_STRIDE, PITCH

#: Centres that are summed at once.
TILE = 64


class Turn(NamedTuple):
    """What is summed, and what is copied meanwhile; all int64."""

    row: int
    """Index of the first grey value of the tile in the first row of the inner outline."""
    fours: int
    """Groups of four rows in each of the two outlines."""
    column: int
    """Index of the tile's first sum."""
    stride: int
    """Of the copies,"""
    first: int
    """the first of them,"""
    each: int
    """how many are carried out after each group, a multiple of `lut.kernels.AT_ONCE`,"""
    to: int
    """and where they begin."""


_I64 = ir.IntType(64)
_BYTES, _SHORTS = (ir.VectorType(ir.IntType(bits), 32) for bits in (8, 16))
_INTS = ir.VectorType(ir.IntType(32), 16)
#: The first 16 of 32 numbers, and the others.
_HALVES = [ir.Constant(ir.VectorType(ir.IntType(32), 16), list(range(k, k + 16))) for k in (0, 16)]


def _number(value: int) -> Any:
    return ir.Constant(_I64, value)


class _Code:
    """Instructions on arrays: those that are arguments of an operation."""

    def __init__(self, context: Any, builder: Any, kinds: Any, args: Any) -> None:
        self.builder, self.kinds = builder, kinds
        self.data = [
            context.make_array(kind)(context, builder, value).data
            if isinstance(kind, types.Array)
            else None
            for kind, value in zip(kinds, args)
        ]

    def load(self, argument: int, index: Any, kind: Any) -> Any:
        """As many numbers as a vector holds, from an index of a contiguous array on."""
        pointer = self.builder.gep(self.data[argument], [index])
        value = self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()))
        value.align = 1
        return value

    def store(self, argument: int, index: Any, value: Any) -> None:
        pointer = self.builder.gep(self.data[argument], [index])
        pointer = self.builder.bitcast(pointer, value.type.as_pointer())
        self.builder.store(value, pointer).align = 1

    def zeros(self, vector: Any) -> Any:
        """A variable; LLVM keeps it in registers."""
        return cgutils.alloca_once_value(self.builder, ir.Constant(vector, [0] * vector.count))

    def times(self, value: Any, factor: int) -> Any:
        return self.builder.mul(value, _number(factor))

    def increase(self, variable: Any, value: Any) -> None:
        self.builder.store(self.builder.add(self.builder.load(variable), value), variable)

    def carry_out(self, stride: Any, first: Any, count: Any, place: Any) -> None:
        """Carry out some copies.

        Arguments 0 to 2 are the pixels, the copies and what is gathered; `place` is a variable.
        """
        builder = self.builder
        done = builder.append_basic_block("done")
        strides = builder.switch(stride, done)
        for every in range(1, LARGEST_STRIDE + 1):
            kept = list(range(0, COPIED, every))
            kept += [kept[-1]] * ((1 << (len(kept) - 1).bit_length()) - len(kept))
            these = ir.Constant(ir.VectorType(ir.IntType(32), len(kept)), kept)
            case = builder.append_basic_block(f"stride_{every}")
            strides.add_case(_number(every), case)
            builder.position_at_end(case)
            with cgutils.for_range(builder, builder.udiv(count, _number(AT_ONCE))) as loop:
                group = builder.add(first, builder.mul(loop.index, _number(AT_ONCE)))
                # The end of a loop is what a processor foresees least.
                for k in range(AT_ONCE):
                    index = builder.add(group, _number(k))
                    copy = builder.load(builder.gep(self.data[1], [index]))
                    if self.kinds[1].dtype.bitwidth < 64:
                        copy = builder.zext(copy, _I64)
                    source = builder.lshr(copy, _number(ADVANCE_BITS))
                    grey = self.load(0, source, ir.VectorType(ir.IntType(8), COPIED))
                    self.store(2, builder.load(place), builder.shuffle_vector(grey, grey, these))
                    low = _number((1 << ADVANCE_BITS) - 1)
                    self.increase(place, builder.and_(copy, low))
            builder.branch(done)
        builder.position_at_end(done)


def _gather(
    _typing: Any, pixels: Any, copies: Any, gathered: Any, stride: Any, first: Any, count: Any,
    to: Any,
) -> Any:  # fmt: skip
    """Carry out some copies, one after the other.

    Parameters
    ----------
    pixels : (H W + 64,) uint8
        The image in scan order, and zeros.
    copies : (N,) uint32 or uint64
        See `lut.DiscTable`.
    gathered : uint8
        Result: rows of 256 grey values, one for each sample; and 64 bytes to spare.
    stride : int64
    first, count : int64
        Which of the copies; a multiple of 4.
    to : int64
        Index in `gathered` at which they begin.

    Returns
    -------
    int64
        Index at which the next copy begins.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = cgutils.alloca_once_value(builder, args[6])
        code = _Code(context, builder, signature.args, args)
        code.carry_out(args[3], args[4], args[5], place)
        return builder.load(place)

    i64 = types.int64
    return i64(pixels, copies, gathered, i64, i64, i64, i64), generate


def _sum_tile(_typing: Any, pixels: Any, copies: Any, gathered: Any, sums: Any, turn: Any) -> Any:
    """Sums for 64 centres, and meanwhile some copies.

    Parameters
    ----------
    pixels, copies, gathered
        As in `gather`.
    sums : (N,) uint16, (N,) uint16, (N,) uint32
        Result: sums of x of the inner and of the outer outline, and of x (255 - x) of both.
    turn : Turn

    Returns
    -------
    int64
        Index at which the next copy begins.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        given = [builder.extract_value(args[4], k) for k in range(len(Turn._fields))]
        row, fours, column, stride, first, each, to = given
        arrays = [*args[:3], *(builder.extract_value(args[3], k) for k in range(3))]
        code = _Code(context, builder, [*signature.args[:3], *sums], arrays)
        place = cgutils.alloca_once_value(builder, to)
        grey = [[code.zeros(_SHORTS) for _ in range(2)] for _ in range(2)]
        products = [[code.zeros(_INTS) for _ in range(2)] for _ in range(2)]
        with cgutils.for_range(builder, fours) as loop:
            begin = builder.add(builder.add(row, column), code.times(loop.index, 4 * PITCH))
            for outline in range(2):
                for part in range(2):
                    x, four = _four_rows(code, builder.add(begin, _number(32 * part)))
                    code.increase(grey[outline][part], x)
                    for half in range(2):
                        some = builder.shuffle_vector(four, four, _HALVES[half])
                        code.increase(products[part][half], builder.zext(some, _INTS))
                begin = builder.add(begin, code.times(fours, 4 * PITCH))
            done = builder.add(first, builder.mul(loop.index, each))
            code.carry_out(stride, done, each, place)
        for part in range(2):
            at = builder.add(column, _number(32 * part))
            for outline in range(2):
                code.store(3 + outline, at, builder.load(grey[outline][part]))
            for half in range(2):
                index = builder.add(at, _number(16 * half))
                code.store(5, index, builder.load(products[part][half]))
        return builder.load(place)

    result = types.int64(pixels, copies, gathered, sums, turn)
    return result, generate


def _four_rows(code: _Code, begin: Any) -> tuple[Any, Any]:
    """Sums of x, and of x (255 - x), of 32 centres in four rows."""
    builder = code.builder
    x, product = [], []
    for k in range(4):
        grey = code.load(2, builder.add(begin, _number(k * PITCH)), _BYTES)
        x.append(builder.zext(grey, _SHORTS))
        # 255 - x is x with its 8 bits turned round.
        turned = builder.xor(x[k], ir.Constant(_SHORTS, [255] * 32))
        product.append(builder.mul(x[k], turned))
    return reduce(builder.add, x), reduce(builder.add, product)


#: What compiled code calls: these, without their first argument.
gather: Callable[..., int] = intrinsic(_gather)
sum_tile: Callable[..., int] = intrinsic(_sum_tile)
