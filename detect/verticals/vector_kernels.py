"""Weighted sums of eight neighbouring grey values at a time, in the compiler's own vectors.

What fits need of single rows: as loops these are too short to be vectorised.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils

from detect.verticals.vector_code import FLOATS, I64, LANES, WORD, Code, operation

__all__ = ["LANES", "WORD", "slope_and_bend", "sum_of_products"]


@operation
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
        code = Code(context, builder, signature, args)
        sums = [code.zeros(), code.zeros()]
        with cgutils.for_range(builder, args[5]) as loop:
            begin = builder.mul(loop.index, code.number(WORD))
            grey = code.grey(0, builder.add(args[1], begin))
            own = builder.add(args[4], begin)
            for argument, variable in ((2, sums[0]), (3, sums[1])):
                code.increase(variable, code.mul(code.load(argument, own, FLOATS), grey))
        first, second = (builder.load(each) for each in sums)
        # Both are halved at once until one number is left of each.
        half = [LANES * (k // 4) + k % 4 for k in range(LANES)]
        both = code.add(
            code.shuffled(first, second, half), code.shuffled(first, second, [k + 4 for k in half])
        )
        for distance in (2, 1):
            moved = [min(k + distance, LANES - 1) for k in range(LANES)]
            both = code.add(both, code.shuffled(both, both, moved))
        numbers = code.scattered(both)
        pair = [numbers[0], numbers[4]]
        return context.make_tuple(builder, signature.return_type, pair)

    result = types.UniTuple(types.float32, 2)(
        pixels, types.int64, first_weights, second_weights, types.int64, types.int64
    )
    return result, generate


@operation
def sum_of_products(
    _typing: Any,
    pixels: Any,
    at: Any,
    weights: Any,
    node: Any,
    count: Any,
    begin: Any,
    half: Any,
) -> Any:
    """Sum of weighted grey values at several places.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    at : int64, contiguous
        The pixel in the middle of each place: there are ``half`` before it.
    weights : float32, contiguous
        Rows of ``2 half`` weights, each of sum 0, as grey values count from 128.
    node : int64, contiguous
        Which row each place takes.
    count : int64
        Number of places.
    begin : int64
        Index of the first row.
    half : int64
        A multiple of `WORD` / 2.

    Returns
    -------
    float32
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        total = code.zeros()
        taps = builder.mul(args[6], code.number(2))
        words = builder.sdiv(taps, code.number(WORD))
        with cgutils.for_range(builder, args[4]) as place:
            pixel = builder.sub(code.load(1, place.index, I64), args[6])
            row = builder.mul(code.load(3, place.index, I64), taps)
            row = builder.add(row, args[5])
            with cgutils.for_range(builder, words) as loop:
                word = builder.mul(loop.index, code.number(WORD))
                grey = code.grey(0, builder.add(pixel, word))
                weight = code.load(2, builder.add(row, word), FLOATS)
                code.increase(total, code.mul(weight, grey))
        numbers = code.scattered(builder.load(total))
        while len(numbers) > 1:
            numbers = [code.add(a, b) for a, b in zip(numbers[::2], numbers[1::2])]
        return numbers[0]

    result = types.float32(pixels, at, weights, node, types.int64, types.int64, types.int64)
    return result, generate
