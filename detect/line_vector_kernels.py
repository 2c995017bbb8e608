"""Eight neighbouring verticals at a time: the filter of tracks, in the compiler's own vectors.

A track needs the response at a few neighbouring columns of the strip in each row. As loops over the
filter's window these are too short to be vectorised; eight neighbours beside each other, a *group*,
fill a vector. The operations are called from compiled code only, and check nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

#: Columns of the strip in one vector: a register of single precision numbers with AVX2.
LANES = 8
#: Numbers kept for one row: mean, covariance and mean square of each lane.
ROW_NUMBERS = 3 * LANES
#: Pixels that are read at once for each lane.
WORD = 8

_I8, _I16, _I32, _I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
_FLOAT = ir.FloatType()
_BYTES = ir.VectorType(_I8, LANES)
_SHORTS = ir.VectorType(_I16, LANES)
_INTS = ir.VectorType(_I32, LANES)
_LONGS = ir.VectorType(_I64, LANES)
_ALL_BYTES = ir.VectorType(_I8, LANES * WORD)
_FLOATS = ir.VectorType(_FLOAT, LANES)
# Products and sums may become one instruction.
_FLAGS = ("contract",)


def _operation(define: Callable[..., Any]) -> Any:
    """An operation that compiled code can call: without the first argument of its definition."""
    return intrinsic(define)


class _Code:
    """What an operation is written with: its arguments, and instructions."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.builder = builder
        self.data = [
            context.make_array(kind)(context, builder, value).data
            if isinstance(kind, types.Array)
            else value
            for kind, value in zip(signature.args, args)
        ]

    def load(self, argument: int, index: Any, kind: Any) -> Any:
        """A number, or as many as a vector holds, from an index of a contiguous array on."""
        value = self.builder.load(self._place(argument, index, kind))
        value.align = 4 if kind in (_FLOAT, _FLOATS) else 1
        return value

    def store(self, argument: int, index: Any, value: Any) -> None:
        self.builder.store(value, self._place(argument, index, value.type)).align = 4

    def _place(self, argument: int, index: Any, kind: Any) -> Any:
        where = self.builder.gep(self.data[argument], [index])
        return self.builder.bitcast(where, kind.as_pointer())

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b, flags=_FLAGS)

    def sub(self, a: Any, b: Any) -> Any:
        return self.builder.fsub(a, b, flags=_FLAGS)

    def mul(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=_FLAGS)

    def everywhere(self, value: Any, vector: Any = _FLOATS) -> Any:
        """A vector of equal numbers."""
        first = self.builder.insert_element(
            ir.Constant(vector, ir.Undefined), value, ir.Constant(_I32, 0)
        )
        return self.builder.shuffle_vector(first, first, ir.Constant(_INTS, [0] * LANES))

    def grey(self, argument: int, index: Any) -> Any:
        """Neighbouring grey values, counted from 128."""
        values = self.load(argument, index, _BYTES)
        # x - 128 is x with its highest bit turned over, as a signed number.
        values = self.builder.xor(values, ir.Constant(_BYTES, [0x80] * LANES))
        return self.builder.sitofp(self.builder.sext(values, _INTS), _FLOATS)

    def shuffled(self, first: Any, second: Any, order: list[int]) -> Any:
        """Numbers of two vectors, counted through, in some order."""
        return self.builder.shuffle_vector(first, second, ir.Constant(_INTS, order))

    def magnitude(self, value: Any) -> Any:
        """Numbers without their signs."""
        bits = self.builder.bitcast(value, _INTS)
        bits = self.builder.and_(bits, ir.Constant(_INTS, [0x7FFFFFFF] * LANES))
        return self.builder.bitcast(bits, _FLOATS)

    def zeros(self) -> Any:
        """A vector that is summed up; LLVM keeps it in registers."""
        return cgutils.alloca_once_value(self.builder, ir.Constant(_FLOATS, [0.0] * LANES))

    def increase(self, variable: Any, value: Any) -> None:
        self.builder.store(self.add(self.builder.load(variable), value), variable)

    def within(self, x: Any, left: Any, right: Any) -> Any:
        """Which numbers lie in [left, right); NaN does not."""
        return self.builder.and_(
            self.builder.fcmp_ordered(">=", x, self.everywhere(left)),
            self.builder.fcmp_ordered("<", x, self.everywhere(right)),
        )

    def only(self, where: Any, value: Any) -> Any:
        """Numbers, and 0 elsewhere."""
        return self.builder.select(where, value, ir.Constant(_FLOATS, [0.0] * LANES))

    def number(self, value: int) -> Any:
        return ir.Constant(_I64, value)


@_operation
def moments_across(
    _typing: Any,
    pixels: Any,
    row_begin: Any,
    strip: Any,
    at: Any,
    left: Any,
    right: Any,
    weights: Any,
    words: Any,
    moments: Any,
    to: Any,
) -> Any:
    """Moments of the grey values in the filter's window across the vertical, for a group in a row.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    row_begin : int64
        Index of the row's first pixel, less the window's half width.
    strip : float32, contiguous
        Columns at which verticals cross rows.
    at : int64
        Index in `strip` of the group's first.
    left, right : float32
        Columns from and below which windows lie inside the image; elsewhere moments are 0.
    weights : (4, T) float32, contiguous
        See `detect.line_filter.LineFilter.weights_between`.
    words : int64
        T / `WORD`.
    moments : float32, contiguous
        Result: mean, covariance and mean square, `LANES` of each; grey values count from 128.
    to : int64
        Index at which they are put.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        mean, cov, square = code.zeros(), code.zeros(), code.zeros()
        x = code.load(2, args[3], _FLOATS)
        inside = code.within(x, args[4], args[5])
        x = builder.select(inside, x, code.everywhere(args[4]))
        whole = builder.fptosi(x, _INTS)
        part = code.sub(x, builder.sitofp(whole, _FLOATS))
        begin = builder.add(builder.sext(whole, _LONGS), code.everywhere(args[1], _LONGS))
        taps = builder.mul(args[7], code.number(WORD))
        # Bytes of equal rank in their words, one rank after the other.
        ranks = [lane * WORD + rank for rank in range(WORD) for lane in range(LANES)]
        with cgutils.for_range(builder, args[7]) as loop:
            first = builder.mul(loop.index, code.number(WORD))
            read = ir.Constant(_LONGS, ir.Undefined)
            for lane in range(LANES):
                number = ir.Constant(_I32, lane)
                index = builder.add(builder.extract_element(begin, number), first)
                read = builder.insert_element(read, code.load(0, index, _I64), number)
            grey_bytes = builder.bitcast(read, _ALL_BYTES)
            grey_bytes = builder.shuffle_vector(
                grey_bytes, grey_bytes, ir.Constant(ir.VectorType(_I32, LANES * WORD), ranks)
            )
            # x - 128 is x with its highest bit turned over, as a signed number.
            grey_bytes = builder.xor(grey_bytes, ir.Constant(_ALL_BYTES, [0x80] * (LANES * WORD)))
            for rank in range(WORD):
                own = ir.Constant(_INTS, [rank * LANES + lane for lane in range(LANES)])
                values = builder.shuffle_vector(grey_bytes, grey_bytes, own)
                grey = builder.sitofp(builder.sext(values, _INTS), _FLOATS)
                tap = builder.add(first, code.number(rank))

                def weight(kind: int, tap: Any = tap) -> Any:
                    on_left, step = (
                        code.everywhere(
                            code.load(
                                6, builder.add(tap, builder.mul(taps, code.number(k))), _FLOAT
                            )
                        )
                        for k in (kind, kind + 1)
                    )
                    return code.add(on_left, code.mul(part, step))

                weighted = code.mul(weight(0), grey)
                code.increase(mean, weighted)
                code.increase(square, code.mul(weighted, grey))
                code.increase(cov, code.mul(weight(2), grey))
        for k, variable in enumerate((mean, cov, square)):
            value = code.only(inside, builder.load(variable))
            code.store(8, builder.add(args[9], code.number(k * LANES)), value)
        return context.get_dummy_value()

    result = types.void(
        pixels, types.int64, strip, types.int64, types.float32, types.float32, weights,
        types.int64, moments, types.int64,
    )  # fmt: skip
    return result, generate


@_operation
def response_along(
    _typing: Any,
    moments: Any,
    first: Any,
    along: Any,
    rows: Any,
    regulariser: Any,
    strip: Any,
    at: Any,
    left: Any,
    right: Any,
    response: Any,
    to: Any,
) -> Any:
    """Responses of a group in a row, from the moments across the vertical in the rows round it.

    Parameters
    ----------
    moments : float32, contiguous
        Of one row after the other, each as `moments_across` puts them.
    first : int64
        Index at which those of the window's first row begin.
    along : float32, contiguous
        The filter's weights along the vertical.
    rows : int64
        Their number.
    regulariser : float32
        Added to the variance.
    strip, at, left, right
        As for `moments_across`, of the row itself: elsewhere the response is 0.
    response : float32, contiguous
        Result, `LANES` of them: cov |cov| / (variance + regulariser).
    to : int64
        Index at which they are put.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        sums = [code.zeros() for _ in range(3)]
        with cgutils.for_range(builder, args[3]) as loop:
            weight = code.everywhere(code.load(2, loop.index, _FLOAT))
            row = builder.add(args[1], builder.mul(loop.index, code.number(ROW_NUMBERS)))
            for k, variable in enumerate(sums):
                value = code.load(0, builder.add(row, code.number(k * LANES)), _FLOATS)
                code.increase(variable, code.mul(weight, value))
        mean, cov, square = (builder.load(each) for each in sums)
        # Rounding can make a vanishing variance negative.
        variance = code.magnitude(code.sub(square, code.mul(mean, mean)))
        below = code.add(variance, code.everywhere(args[4]))
        value = builder.fdiv(code.mul(cov, code.magnitude(cov)), below, flags=_FLAGS)
        inside = code.within(code.load(5, args[6], _FLOATS), args[7], args[8])
        code.store(9, args[10], code.only(inside, value))
        return context.get_dummy_value()

    result = types.void(
        moments, types.int64, along, types.int64, types.float32, strip, types.int64,
        types.float32, types.float32, response, types.int64,
    )  # fmt: skip
    return result, generate


@_operation
def slope_and_bend(
    _typing: Any,
    pixels: Any,
    at: Any,
    first_weights: Any,
    second_weights: Any,
    at_weight: Any,
    words: Any,
) -> Any:
    """Sums of grey values, weighted in two ways.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    at : int64
        The first pixel.
    first_weights, second_weights : float32, contiguous
        Weights; the sum of those used is to be 0, as grey values count from 128.
    at_weight : int64
        Index of the first of them.
    words : int64
        Their number / `WORD`.

    Returns
    -------
    first, second : float32
        The sums.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        sums = [code.zeros(), code.zeros()]
        with cgutils.for_range(builder, args[5]) as loop:
            begin = builder.mul(loop.index, code.number(WORD))
            grey = code.grey(0, builder.add(args[1], begin))
            own = builder.add(args[4], begin)
            for argument, variable in ((2, sums[0]), (3, sums[1])):
                code.increase(variable, code.mul(code.load(argument, own, _FLOATS), grey))
        first, second = (builder.load(each) for each in sums)
        # Both are halved at once until one number is left of each.
        half = [LANES * (k // 4) + k % 4 for k in range(LANES)]
        both = code.add(
            code.shuffled(first, second, half), code.shuffled(first, second, [k + 4 for k in half])
        )
        for distance in (2, 1):
            moved = [min(k + distance, LANES - 1) for k in range(LANES)]
            both = code.add(both, code.shuffled(both, both, moved))
        pair = [builder.extract_element(both, ir.Constant(_I32, k)) for k in (0, 4)]
        return context.make_tuple(builder, signature.return_type, pair)

    result = types.UniTuple(types.float32, 2)(
        pixels, types.int64, first_weights, second_weights, types.int64, types.int64
    )
    return result, generate


@_operation
def add_products(
    _typing: Any, pixels: Any, at: Any, weights: Any, at_weight: Any, words: Any, sums: Any, to: Any
) -> Any:
    """Add weighted grey values to a vector whose numbers are to be summed up in the end.

    Parameters
    ----------
    pixels, at, weights, at_weight, words
        As for `slope_and_bend`.
    sums : float32, contiguous
        Changed: `LANES` of its numbers.
    to : int64
        Index of the first of them.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        total = cgutils.alloca_once_value(builder, code.load(5, args[6], _FLOATS))
        with cgutils.for_range(builder, args[4]) as loop:
            begin = builder.mul(loop.index, code.number(WORD))
            grey = code.grey(0, builder.add(args[1], begin))
            weight = code.load(2, builder.add(args[3], begin), _FLOATS)
            code.increase(total, code.mul(weight, grey))
        code.store(5, args[6], builder.load(total))
        return context.get_dummy_value()

    result = types.void(pixels, types.int64, weights, types.int64, types.int64, sums, types.int64)
    return result, generate


@_operation
def interpolate(
    _typing: Any, pixels: Any, where: Any, part: Any, grey: Any, square: Any, at: Any
) -> Any:
    """Grey values between neighbouring pixels, and their squares, at `LANES` places.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    where : int32, contiguous
        The pixel on the left of each place; -1 for none: both results are 0.
    part : float32, contiguous
        How far to the right of it each lies, 0 to 1.
    grey, square : float32, contiguous
        Results; grey values count from 128.
    at : int64
        Index of the first place in all of these.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        left_of = code.load(1, args[5], _INTS)
        zero = ir.Constant(_INTS, [0] * LANES)
        some = builder.icmp_signed(">=", left_of, zero)
        left_of = builder.sext(builder.select(some, left_of, zero), _LONGS)
        pairs = ir.Constant(_SHORTS, ir.Undefined)
        for lane in range(LANES):
            number = ir.Constant(_I32, lane)
            pair = code.load(0, builder.extract_element(left_of, number), _I16)
            pairs = builder.insert_element(pairs, pair, number)
        # x - 128 is x with its highest bit turned over, as a signed number.
        pairs = builder.xor(pairs, ir.Constant(_SHORTS, [0x8080] * LANES))
        left, right = (
            builder.sitofp(builder.sext(builder.trunc(each, _BYTES), _INTS), _FLOATS)
            for each in (pairs, builder.lshr(pairs, ir.Constant(_SHORTS, [8] * LANES)))
        )
        share = code.load(2, args[5], _FLOATS)
        for argument in (3, 4):
            between = code.add(left, code.mul(share, code.sub(right, left)))
            code.store(argument, args[5], code.only(some, between))
            left, right = code.mul(left, left), code.mul(right, right)
        return context.get_dummy_value()

    result = types.void(pixels, where, part, grey, square, types.int64)
    return result, generate
