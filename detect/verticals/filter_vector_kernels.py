"""The filter of tracks for eight neighbouring verticals, in one row or in two at once.

A track needs the response at a few neighbouring columns of the strip in each row. As loops over the
filter's window these are too short to be vectorised; eight neighbours beside each other, a *group*,
fill a vector, and two rows of a group one of twice the size. Both give the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from detect.vector_code import FLOAT, I32, I64, LANES, WORD, Code, constant, operation

#: Bytes of a word that are turned to numbers together: half of it.
_HALF = WORD // 2


def _moments(rows: int) -> Callable[..., Any]:
    floats, ints = (ir.VectorType(kind, rows * LANES) for kind in (FLOAT, I32))

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        mean, cov, square = (code.zeros(floats) for _ in range(3))
        x = code.load(3, args[4], floats)
        inside = code.within(x, args[5], args[6])
        x = builder.select(inside, x, code.everywhere(args[5], floats))
        whole = builder.fptosi(x, ints)
        part = code.sub(x, builder.sitofp(whole, floats))
        begin = []
        for lane, own in enumerate(code.scattered(whole)):
            at = builder.add(args[1], builder.sext(own, I64))
            begin.append(at if lane < LANES else builder.add(at, args[2]))
        taps = builder.mul(args[8], code.number(WORD))

        def weight(kind: int, tap: Any) -> Any:
            on_left, step = (
                code.load(7, builder.add(tap, builder.mul(taps, code.number(k))), FLOAT)
                for k in (kind, kind + 1)
            )
            along = code.mul(part, code.everywhere(step, floats))
            return code.add(code.everywhere(on_left, floats), along)

        with cgutils.for_range(builder, args[8]) as loop:
            first = builder.mul(loop.index, code.number(WORD))
            words = code.gathered([code.load(0, builder.add(at, first), I64) for at in begin])
            halves = builder.bitcast(words, ir.VectorType(I32, 2 * rows * LANES))
            for half in range(2):
                order = list(range(half, 2 * rows * LANES, 2))
                four = code.shuffled(halves, halves, order)
                # x - 128 is x with its highest bit turned over, as a signed number.
                four = builder.xor(four, constant(ints, 0x80808080))
                for rank in range(_HALF):
                    byte = builder.shl(four, constant(ints, 8 * (_HALF - 1 - rank)))
                    byte = builder.ashr(byte, constant(ints, 8 * (_HALF - 1)))
                    grey = builder.sitofp(byte, floats)
                    tap = builder.add(first, code.number(half * _HALF + rank))
                    weighted = code.mul(weight(0, tap), grey)
                    code.increase(mean, weighted)
                    code.increase(square, code.mul(weighted, grey))
                    code.increase(cov, code.mul(weight(2, tap), grey))
        for k, variable in enumerate((mean, cov, square)):
            value = code.only(inside, builder.load(variable))
            place = builder.add(args[11], builder.mul(args[10], code.number(k)))
            code.store(9, place, value)
        return context.get_dummy_value()

    return generate


def _moments_type(pixels: Any, strip: Any, weights: Any, moments: Any) -> Any:
    return types.void(
        pixels, types.int64, types.int64, strip, types.int64, types.float32, types.float32, weights,
        types.int64, moments, types.int64, types.int64,
    )  # fmt: skip


@operation
def moments_across(
    _typing: Any,
    pixels: Any,
    row_begin: Any,
    row_length: Any,
    strip: Any,
    at: Any,
    left: Any,
    right: Any,
    weights: Any,
    words: Any,
    moments: Any,
    plane: Any,
    to: Any,
) -> Any:
    """Moments of the grey values in the filter's window across the vertical, for a group in a row.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    row_begin : int64
        Index of the row's first pixel, less the window's half width.
    row_length : int64
        Pixels from there to the next row.
    strip : float32, contiguous
        Columns at which a group's verticals cross rows, row by row.
    at : int64
        Index in `strip` of the group's first.
    left, right : float32
        Columns from and below which windows are inside the image; elsewhere moments are 0.
    weights : (4, T) float32, contiguous
        See `detect.verticals.response.LineFilter.weights_between`.
    words : int64
        T / `WORD`.
    moments : float32, contiguous
        Result: means, covariances and mean squares, each in a plane of its own, row by row; grey
        values count from 128.
    plane : int64
        Numbers from one plane to the next.
    to : int64
        Index at which means are put.
    """
    return _moments_type(pixels, strip, weights, moments), _moments(1)


@operation
def moments_across_two(
    _typing: Any,
    pixels: Any,
    row_begin: Any,
    row_length: Any,
    strip: Any,
    at: Any,
    left: Any,
    right: Any,
    weights: Any,
    words: Any,
    moments: Any,
    plane: Any,
    to: Any,
) -> Any:
    """As `moments_across`, for the next row as well."""
    return _moments_type(pixels, strip, weights, moments), _moments(2)


def _response(rows: int) -> Callable[..., Any]:
    floats = ir.VectorType(FLOAT, rows * LANES)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        sums = [code.zeros(floats) for _ in range(3)]
        with cgutils.for_range(builder, args[5]) as loop:
            own = code.load(3, builder.add(args[4], loop.index), FLOAT)
            weight = code.everywhere(own, floats)
            row = builder.add(args[2], builder.mul(loop.index, code.number(LANES)))
            for k, variable in enumerate(sums):
                place = builder.add(row, builder.mul(args[1], code.number(k)))
                code.increase(variable, code.mul(weight, code.load(0, place, floats)))
        scale = code.everywhere(args[6], floats)
        mean, cov, square = (code.mul(scale, builder.load(each)) for each in sums)
        # Rounding can make a vanishing variance negative.
        variance = code.magnitude(code.sub(square, code.mul(mean, mean)))
        below = code.add(variance, code.everywhere(args[7], floats))
        value = code.divide(code.mul(cov, code.magnitude(cov)), below)
        inside = code.within(code.load(8, args[9], floats), args[10], args[11])
        code.store(12, args[13], code.only(inside, value))
        return context.get_dummy_value()

    return generate


def _response_type(moments: Any, along: Any, strip: Any, response: Any) -> Any:
    return types.void(
        moments, types.int64, types.int64, along, types.int64, types.int64, types.float32,
        types.float32, strip, types.int64, types.float32, types.float32, response, types.int64,
    )  # fmt: skip


@operation
def response_along(
    _typing: Any,
    moments: Any,
    plane: Any,
    first: Any,
    along: Any,
    at_weight: Any,
    rows: Any,
    scale: Any,
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
    moments, plane
        As `moments_across` puts them.
    first : int64
        Index of the means of the window's first row.
    along : float32, contiguous
        The filter's weights along the vertical.
    at_weight : int64
        Index of the weight of that row.
    rows : int64
        How many rows there are in the window.
    scale : float32
        One over the sum of their weights.
    regulariser : float32
        Added to the variance.
    strip, at, left, right
        As for `moments_across`, of the row itself: elsewhere the response is 0.
    response : float32, contiguous
        Result, `LANES` of them: cov |cov| / (variance + regulariser).
    to : int64
        Index at which they are put.
    """
    return _response_type(moments, along, strip, response), _response(1)


@operation
def response_along_two(
    _typing: Any,
    moments: Any,
    plane: Any,
    first: Any,
    along: Any,
    at_weight: Any,
    rows: Any,
    scale: Any,
    regulariser: Any,
    strip: Any,
    at: Any,
    left: Any,
    right: Any,
    response: Any,
    to: Any,
) -> Any:
    """As `response_along`, for the next row as well."""
    return _response_type(moments, along, strip, response), _response(2)
