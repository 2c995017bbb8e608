"""Sums of the refinement of lines over the rows that they cross, `ROWS` rows at a time.

Each row has its own place in the image and its own weights: what is alike in all of them is done
in vectors of one number for each row, and the rest, weighted sums of eight grey values at a time,
row by row.
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
    I32,
    INTS,
    LANES,
    WORD,
    Code,
    constant,
    operation,
)

__all__ = ["ROWS", "SUBPIXELS", "heights", "move_crossings", "newton_sums"]

#: Positions in a pixel for which weights are tabulated; between them the derivative helps out.
SUBPIXELS = 64

#: Number of rows that are processed together.
ROWS = LANES
# How many numbers `newton_sums` returns.
_SUMS = 9

_DOUBLE = ir.DoubleType()
_DOUBLES = ir.VectorType(_DOUBLE, ROWS)
_TWICE = 2 * LANES
_TWICE_FLOATS = ir.VectorType(FLOAT, _TWICE)
_TWICE_BYTES = ir.VectorType(BYTES.element, _TWICE)
_TWICE_INTS = ir.VectorType(I32, _TWICE)


class _Places:
    """Where `ROWS` rows are crossed, and which weights are for that."""

    def __init__(self, code: Code, crossing: Any, row_begin: Any, left: Any, right: Any) -> None:
        self._code = code
        builder = code.builder
        self.inside = builder.and_(
            builder.fcmp_ordered(">", crossing, code.everywhere(left, _DOUBLES)),
            builder.fcmp_ordered("<", crossing, code.everywhere(right, _DOUBLES)),
        )
        whole = builder.fptosi(crossing, INTS)
        part = code.sub(crossing, builder.sitofp(whole, _DOUBLES))
        node = builder.fptosi(code.mul(part, constant(_DOUBLES, float(SUBPIXELS))), INTS)
        middle = code.add(builder.sitofp(node, _DOUBLES), constant(_DOUBLES, 0.5))
        middle = code.mul(middle, constant(_DOUBLES, 1.0 / SUBPIXELS))
        #: From the tabulated position to the crossing; nothing where there is none.
        self.off = code.only(self.inside, code.sub(part, middle))
        # The row of weights behind the last one is of zeros.
        self.node = builder.select(self.inside, node, constant(INTS, SUBPIXELS))
        self._pixel = builder.add(row_begin, whole)

    def pixels_from(self, half: Any) -> Any:
        """Indices of the first pixels that a filter covers; of the image where there are none."""
        builder = self._code.builder
        before = builder.sub(builder.trunc(half, I32), ir.Constant(I32, 1))
        pixel = builder.sub(self._pixel, self._code.everywhere(before, INTS))
        return builder.select(self.inside, pixel, constant(INTS, 0))

    def rows_of(self, length: Any) -> Any:
        """Indices of the rows of weights in a table of rows of some length."""
        length = self._code.builder.trunc(length, I32)
        return self._code.builder.mul(self.node, self._code.everywhere(length, INTS))


def _sum(code: Code, vector: Any) -> Any:
    """The sum of a vector's numbers."""
    while vector.type.count > 2:
        half = list(range(vector.type.count // 2))
        upper = [k + len(half) for k in half]
        vector = code.add(code.shuffled(vector, vector, half), code.shuffled(vector, vector, upper))
    return code.add(*code.scattered(vector))


@operation
def newton_sums(
    _typing: Any,
    pixels: Any,
    row_begin: Any,
    crossing: Any,
    by_a: Any,
    by_b: Any,
    blocks: Any,
    weights: Any,
    begin: Any,
    half: Any,
    left: Any,
    right: Any,
) -> Any:
    """Sums over a line's rows for a step of Newton's method.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order.
    row_begin : int32, contiguous
        Index of the first pixel of each row.
    crossing : float64, contiguous
        Column at which the line crosses it; NaN for none.
    by_a, by_b : float64, contiguous
        Its derivatives by the line's parameters; 0 where there is none.
    blocks : int64
        Number of rows / `ROWS`.
    weights : float32, contiguous
        See `detect.verticals.refinement.StepFilters.derivatives`.
    begin : int64
        Index of the filter's first weight.
    half : int64
        Half the number of pixels that the filter covers.
    left, right : float64
        Columns between which crossings count.

    Returns
    -------
    tuple of float64
        With the first and second derivative of the response in each row, s and t: the sums of
        t a a, t a b, t b b; s a, s b; (s a)^2, s a s b, (s b)^2; and the number of rows that count.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        sums = [code.zeros(_DOUBLES) for _ in range(_SUMS)]
        words = builder.sdiv(builder.mul(args[8], code.number(2)), code.number(WORD))
        length = builder.mul(words, code.number(_TWICE))
        with cgutils.for_range(builder, args[5]) as loop:
            at = builder.mul(loop.index, code.number(ROWS))
            row_begin = code.load(1, at, INTS)
            crossing = code.load(2, at, _DOUBLES)
            places = _Places(code, crossing, row_begin, *args[9:11])
            pixel = code.pointers(0, places.pixels_from(args[8]))
            own = code.pointers(6, places.rows_of(length), args[7])
            totals = [code.zeros(_TWICE_FLOATS) for _ in range(ROWS)]
            for total in totals:
                builder.store(constant(_TWICE_FLOATS, 0.0), total)
            with cgutils.for_range(builder, words) as word:
                further = builder.mul(word.index, code.number(WORD))
                further_weights = builder.mul(word.index, code.number(_TWICE))
                for row in range(ROWS):
                    grey = _twice_grey(code, pixel[row], further)
                    weight = code.load_from(own[row], further_weights, _TWICE_FLOATS)
                    code.increase(totals[row], code.mul(weight, grey))
            slope, bend = _each_sum(code, [builder.load(total) for total in totals])
            slope, bend = builder.fpext(slope, _DOUBLES), builder.fpext(bend, _DOUBLES)
            slope = code.add(slope, code.mul(places.off, bend))
            a, b = code.load(3, at, _DOUBLES), code.load(4, at, _DOUBLES)
            bend_a, bend_b = code.mul(bend, a), code.mul(bend, b)
            slope_a, slope_b = code.mul(slope, a), code.mul(slope, b)
            products = (
                (bend_a, a), (bend_a, b), (bend_b, b), (slope_a, None), (slope_b, None),
                (slope_a, slope_a), (slope_a, slope_b), (slope_b, slope_b),
            )  # fmt: skip
            for total, (first, second) in zip(sums, products):
                code.increase(total, first if second is None else code.mul(first, second))
            code.increase(sums[-1], code.only(places.inside, constant(_DOUBLES, 1.0)))
        results = [_sum(code, builder.load(total)) for total in sums]
        return context.make_tuple(builder, signature.return_type, results)

    result = types.UniTuple(types.float64, _SUMS)(
        pixels, row_begin, crossing, by_a, by_b, types.int64, weights, types.int64, types.int64,
        types.float64, types.float64,
    )  # fmt: skip
    return result, generate


def _twice_grey(code: Code, begin: Any, index: Any) -> Any:
    """Neighbouring grey values, counted from 128, two times."""
    values = code.load_from(begin, index, BYTES)
    values = code.shuffled(values, values, [*range(LANES), *range(LANES)])
    # x - 128 is x with its highest bit turned over, as a signed number.
    values = code.builder.xor(values, constant(_TWICE_BYTES, 0x80))
    return code.builder.sitofp(code.builder.sext(values, _TWICE_INTS), _TWICE_FLOATS)


def _each_sum(code: Code, rows: list[Any]) -> tuple[Any, Any]:
    """The sum of the first half of each of `ROWS` vectors, and that of the second."""
    quarters = range(0, _TWICE, 4)
    # In each quarter: two numbers of either of two rows, then one of each of four.
    for order in (
        [[q, q + _TWICE, q + 1, q + 1 + _TWICE] for q in quarters],
        [[q, q + 1, q + _TWICE, q + 1 + _TWICE] for q in quarters],
    ):
        lower = [index for quarter in order for index in quarter]
        upper = [index + 2 for index in lower]
        rows = [
            code.add(code.shuffled(a, b, lower), code.shuffled(a, b, upper))
            for a, b in zip(rows[::2], rows[1::2])
        ]
    a, b = rows
    even = [q + k for q in (0, 8, _TWICE, _TWICE + 8) for k in range(4)]
    both = code.add(code.shuffled(a, b, even), code.shuffled(a, b, [k + 4 for k in even]))
    first, second = (
        code.shuffled(both, both, [q + k for q in (at, at + 8) for k in range(4)]) for at in (0, 4)
    )
    return first, second


@operation
def move_crossings(
    _typing: Any, crossing: Any, by_a: Any, by_b: Any, blocks: Any, change_a: Any, change_b: Any
) -> Any:
    """Move a line's crossings as its parameters change.

    Parameters
    ----------
    crossing, by_a, by_b, blocks
        As for `newton_sums`.
    change_a, change_b : float64
        By how much.

    Returns
    -------
    float64
        How far the crossing that moves most does.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        largest = code.zeros(_DOUBLES)
        with cgutils.for_range(builder, args[3]) as loop:
            at = builder.mul(loop.index, code.number(ROWS))
            change = code.add(
                code.mul(code.everywhere(args[4], _DOUBLES), code.load(1, at, _DOUBLES)),
                code.mul(code.everywhere(args[5], _DOUBLES), code.load(2, at, _DOUBLES)),
            )
            code.store(0, at, code.add(code.load(0, at, _DOUBLES), change))
            size = builder.select(
                builder.fcmp_ordered("<", change, constant(_DOUBLES, 0.0)),
                builder.fsub(constant(_DOUBLES, 0.0), change),
                change,
            )
            most = builder.load(largest)
            most = builder.select(builder.fcmp_ordered(">", size, most), size, most)
            builder.store(most, largest)
        numbers = code.scattered(builder.load(largest))
        while len(numbers) > 1:
            numbers = [
                builder.select(builder.fcmp_ordered(">", a, b), a, b)
                for a, b in zip(numbers[::2], numbers[1::2])
            ]
        return numbers[0]

    result = types.float64(crossing, by_a, by_b, types.int64, types.float64, types.float64)
    return result, generate


@operation
def heights(
    _typing: Any,
    pixels: Any,
    row_begin: Any,
    crossing: Any,
    blocks: Any,
    weights: Any,
    fine_begin: Any,
    fine_half: Any,
    coarse_begin: Any,
    coarse_half: Any,
    left: Any,
    right: Any,
) -> Any:
    """Heights of the step that a line's rows show to two filters, summed up.

    Parameters
    ----------
    pixels, row_begin, crossing, blocks, left, right
        As for `newton_sums`.
    weights : float32, contiguous
        See `detect.verticals.refinement.StepFilters.height`.
    fine_begin, coarse_begin : int64
        Index of each filter's first weight.
    fine_half, coarse_half : int64
        Half the number of pixels that each covers.

    Returns
    -------
    fine, coarse, number : float64
        Their sums, and the number of rows that count.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature, args)
        # Several of each filter: additions need not wait for each other.
        totals = [[code.zeros() for _ in range(ROWS // 2)] for _ in range(2)]
        number = code.zeros(_DOUBLES)
        with cgutils.for_range(builder, args[3]) as loop:
            at = builder.mul(loop.index, code.number(ROWS))
            row_begin, crossing = code.load(1, at, INTS), code.load(2, at, _DOUBLES)
            places = _Places(code, crossing, row_begin, *args[9:11])
            code.increase(number, code.only(places.inside, constant(_DOUBLES, 1.0)))
            for begin, half, own in zip(args[5:9:2], args[6:9:2], totals):
                taps = builder.mul(half, code.number(2))
                pixel = code.pointers(0, places.pixels_from(half))
                weights = code.pointers(4, places.rows_of(taps), begin)
                words = builder.sdiv(taps, code.number(WORD))
                with cgutils.for_range(builder, words) as word:
                    further = builder.mul(word.index, code.number(WORD))
                    for row in range(ROWS):
                        grey = code.grey_from(pixel[row], further)
                        weight = code.load_from(weights[row], further, FLOATS)
                        code.increase(own[row % len(own)], code.mul(weight, grey))
        results = []
        for own in totals:
            total = [builder.load(each) for each in own]
            while len(total) > 1:
                total = [code.add(a, b) for a, b in zip(total[::2], total[1::2])]
            results.append(builder.fpext(_sum(code, total[0]), _DOUBLE))
        results.append(_sum(code, builder.load(number)))
        return context.make_tuple(builder, signature.return_type, results)

    result = types.UniTuple(types.float64, 3)(
        pixels, row_begin, crossing, types.int64, weights, types.int64, types.int64, types.int64,
        types.int64, types.float64, types.float64,
    )  # fmt: skip
    return result, generate
