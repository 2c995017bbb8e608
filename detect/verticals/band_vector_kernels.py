"""Moments for the filter on rows parallel to the horizon, many neighbouring columns at a time.

Plain loops over the columns, one for each weight, would read memory once per weight.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from detect.vector_code import (
    BYTES,
    FLOAT,
    FLOATS,
    I8,
    I16,
    I32,
    I64,
    INTS,
    LONGS,
    SHORTS,
    Code,
    constant,
    operation,
)

__all__ = [
    "BLOCK",
    "RUN",
    "TILE",
    "interpolate",
    "interpolate_runs",
    "response_across",
    "sums_along",
]

#: Columns that are summed up together: as many as fill the registers of most processors.
BLOCK = 32
#: Columns whose grey values, in all rows of the band, fit into the innermost cache.
TILE = 2 * BLOCK

#: Number of neighbouring places between pixels that are processed together.
RUN = 16

_BLOCK_FLOATS = ir.VectorType(FLOAT, BLOCK)
_RUN_BYTES, _RUN_INTS, _RUN_FLOATS = (ir.VectorType(kind, RUN) for kind in (I8, I32, FLOAT))


@operation
def interpolate(
    _typing: Any,
    pixels: Any,
    where: Any,
    part: Any,
    at: Any,
    between: Any,
    plane: Any,
    to: Any,
) -> Any:
    """Grey values between neighbouring pixels, and their squares, at `LANES` places.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    where : int32, contiguous
        The pixel on the left of each place; -1 for none: both results are 0.
    part : float32, contiguous
        How far to the right of it each is, 0 to 1.
    at : int64
        Index of the first place in both.
    between : float32, contiguous
        Results; grey values count from 128.
    plane : int64
        Numbers in `between` from grey values to their squares.
    to : int64
        Index at which grey values are put.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        left_of = code.load(1, args[3], INTS)
        zero = constant(INTS, 0)
        some = builder.icmp_signed(">=", left_of, zero)
        left_of = builder.sext(builder.select(some, left_of, zero), LONGS)
        pairs = code.gathered([code.load(0, place, I16) for place in code.scattered(left_of)])
        # x - 128 is x with its highest bit turned over, as a signed number.
        pairs = builder.xor(pairs, constant(SHORTS, 0x8080))
        left, right = (
            builder.sitofp(builder.sext(builder.trunc(each, BYTES), INTS), FLOATS)
            for each in (pairs, builder.lshr(pairs, constant(SHORTS, 8)))
        )
        results = _between(code, left, right, code.load(2, args[3], FLOATS))
        for place, value in zip((args[6], builder.add(args[6], args[5])), results):
            code.store(4, place, code.only(some, value))
        return context.get_dummy_value()

    result = types.void(pixels, where, part, types.int64, between, types.int64, types.int64)
    return result, generate


@operation
def interpolate_runs(
    _typing: Any,
    pixels: Any,
    runs: Any,
    lengths: Any,
    part: Any,
    block: Any,
    between: Any,
    plane: Any,
    to: Any,
) -> Any:
    """As `interpolate`, for a row of a tile, where most pixels are neighbours.

    Those on the left of `RUN` places are, but for a break or two: three runs of neighbours.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    runs : (N, 3) int32, contiguous
        The pixel on the left of the first of `RUN` places, for each run as if all were of it; the
        image continues for `RUN` pixels behind these.
    lengths : (N, 2) uint8, contiguous
        The number of the first place that is not of the first run, and not of the second.
    part : float32, contiguous
        See `interpolate`.
    block : int64
        Index in `runs` and `lengths` of the first `RUN` places, of which there are ``TILE / RUN``;
        pixels as far on again are prefetched.
    between, plane, to
        As for `interpolate`.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        lane = ir.Constant(_RUN_BYTES, list(range(RUN)))
        for k in range(TILE // RUN):
            block = builder.add(args[4], code.number(k))
            own = builder.mul(block, code.number(3))
            begin = [
                builder.sext(code.load(1, builder.add(own, code.number(run)), I32), I64)
                for run in range(3)
            ]
            if k == 0:
                code.prefetch(0, builder.add(begin[0], code.number(TILE)))
            own = builder.mul(block, code.number(2))
            of_run = []
            for run in range(2):
                length = code.load(2, builder.add(own, code.number(run)), I8)
                of_run.append(builder.icmp_unsigned("<", lane, code.everywhere(length, _RUN_BYTES)))
            sides = []
            for side in range(2):
                first, second, third = (
                    code.load(0, builder.add(each, code.number(side)), _RUN_BYTES) for each in begin
                )
                values = builder.select(of_run[1], second, third)
                values = builder.select(of_run[0], first, values)
                # x - 128 is x with its highest bit turned over, as a signed number.
                values = builder.xor(values, constant(_RUN_BYTES, 0x80))
                sides.append(builder.sitofp(builder.sext(values, _RUN_INTS), _RUN_FLOATS))
            shares = code.load(3, builder.mul(block, code.number(RUN)), _RUN_FLOATS)
            to = builder.add(args[7], code.number(k * RUN))
            results = _between(code, sides[0], sides[1], shares)
            for place, value in zip((to, builder.add(to, args[6])), results):
                code.store(5, place, value)
        return context.get_dummy_value()

    result = types.void(pixels, runs, lengths, part, types.int64, between, types.int64, types.int64)
    return result, generate


def _between(code: Code, left: Any, right: Any, part: Any) -> tuple[Any, Any]:
    """Values between two, and their squares between those of the two."""
    step = code.mul(part, code.sub(right, left))
    square = code.add(code.mul(left, left), code.mul(step, code.add(left, right)))
    return code.add(left, step), square


@operation
def sums_along(
    _typing: Any,
    between: Any,
    plane: Any,
    first: Any,
    stride: Any,
    weights: Any,
    taps: Any,
    scale: Any,
    at_scale: Any,
    sums: Any,
    sums_plane: Any,
    to: Any,
) -> Any:
    """Weighted sums of rows, of two planes at once, for `BLOCK` columns.

    Parameters
    ----------
    between : float32, contiguous
        The numbers; those of the second plane are `plane` behind those of the first.
    plane, first : int64
        See above; index of the first column in the first row.
    stride : int64
        Numbers from one row to the next.
    weights : float32, contiguous
        Of the rows.
    taps : int64
        How many rows.
    scale : float32, contiguous
        The factor of each column's sums.
    at_scale : int64
        Index there of the first column.
    sums, sums_plane, to
        Results, addressed like `between`, `plane` and `first`.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        totals = [code.zeros(_BLOCK_FLOATS) for _ in range(2)]
        with cgutils.for_range(builder, args[5]) as loop:
            weight = code.everywhere(code.load(4, loop.index, FLOAT), _BLOCK_FLOATS)
            row = builder.add(args[2], builder.mul(loop.index, args[3]))
            for place, total in zip((row, builder.add(row, args[1])), totals):
                code.increase(total, code.mul(weight, code.load(0, place, _BLOCK_FLOATS)))
        own_scale = code.load(6, args[7], _BLOCK_FLOATS)
        for place, total in zip((args[10], builder.add(args[10], args[9])), totals):
            code.store(8, place, code.mul(own_scale, builder.load(total)))
        return context.get_dummy_value()

    result = types.void(
        between, types.int64, types.int64, types.int64, weights, types.int64, scale, types.int64,
        sums, types.int64, types.int64,
    )  # fmt: skip
    return result, generate


@operation
def response_across(
    _typing: Any,
    sums: Any,
    plane: Any,
    at: Any,
    weights: Any,
    at_weight: Any,
    taps: Any,
    regulariser: Any,
    response: Any,
    to: Any,
) -> Any:
    """Responses at `BLOCK` columns, from sums along the verticals.

    Parameters
    ----------
    sums : float32, contiguous
        Means of grey values along each vertical; those of their squares are `plane` behind them.
    plane, at : int64
        See above; index of the first column that counts for the first response.
    weights : float32, contiguous
        Weights of the mean, then of the covariance.
    at_weight : int64
        Index of the first of them.
    taps : int64
        How many of each.
    regulariser : float32
        Added to the variance.
    response : float32, contiguous
        Results: cov |cov| / (variance + regulariser).
    to : int64
        Index of the first.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        mean, cov, square = (code.zeros(_BLOCK_FLOATS) for _ in range(3))
        with cgutils.for_range(builder, args[5]) as loop:
            tap = builder.add(args[4], loop.index)
            weight, lever = (
                code.everywhere(code.load(3, place, FLOAT), _BLOCK_FLOATS)
                for place in (tap, builder.add(tap, args[5]))
            )
            place = builder.add(args[2], loop.index)
            grey = code.load(0, place, _BLOCK_FLOATS)
            code.increase(mean, code.mul(weight, grey))
            code.increase(cov, code.mul(lever, grey))
            squares = code.load(0, builder.add(place, args[1]), _BLOCK_FLOATS)
            code.increase(square, code.mul(weight, squares))
        of_mean, of_cov, of_square = (builder.load(each) for each in (mean, cov, square))
        # Rounding can make a vanishing variance negative.
        variance = code.magnitude(code.sub(of_square, code.mul(of_mean, of_mean)))
        below = code.add(variance, code.everywhere(args[6], _BLOCK_FLOATS))
        above = code.mul(of_cov, code.magnitude(of_cov))
        code.store(7, args[8], code.divide(above, below))
        return context.get_dummy_value()

    result = types.void(
        sums, types.int64, types.int64, weights, types.int64, types.int64, types.float32, response,
        types.int64,
    )  # fmt: skip
    return result, generate
