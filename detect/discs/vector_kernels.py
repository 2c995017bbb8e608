"""Sixty-four pixels at a time, in the compiler's own vectors.

These few operations are where the disc detector's time goes. As loops they are vectorised by half
at best (the widest number in a loop decides how many pixels are worked on at once), so they are
given to LLVM as operations on vectors, which it turns into whatever the processor has. They are
called from compiled code only, and check nothing: see `detect.discs.quality_kernels` for what goes
in.

Grey values of the outlines are gathered as rows of bytes, one row for each sample, one column for
each centre. Their squares are summed by way of the product of a grey value and its complement,
x (255 - x): four of these fit into 16 bits, and x^2 = 255 x - x (255 - x).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from lut.kernels import ADVANCE_BITS, BLOCK, GROUP, LEAST_COPIES

#: Pixels in one vector: a register of 16-bit numbers on processors with AVX-512, two with AVX2.
LANES = 32

_PARTS = range(BLOCK // LANES)

_I8, _I16, _I32, _I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
_BLOCK = ir.VectorType(_I8, BLOCK)
_BYTES = ir.VectorType(_I8, LANES)
_SHORTS = ir.VectorType(_I16, LANES)
# Of these half as many: numbers of pixels 0, 2, 4, ... or of 1, 3, 5, ...
_INTS = ir.VectorType(_I32, LANES // 2)
_FLOATS = ir.VectorType(ir.FloatType(), LANES // 2)


def _operation(define: Callable[..., Any]) -> Any:
    """An operation that compiled code can call: without the first argument of its definition."""
    return intrinsic(define)


class _Code:
    """What an operation is written with: its arguments, and instructions."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.add, self.sub, self.mul = builder.add, builder.sub, builder.mul
        self.builder, self.context, self.kinds, self.args = builder, context, signature.args, args

    def number(self, value: int) -> Any:
        return ir.Constant(_I64, value)

    def load(self, argument: int, index: Any, kind: Any) -> Any:
        """A number, or as many as a vector holds, from an index of a contiguous array on."""
        pointer, align = self._place(argument, index, kind)
        value = self.builder.load(pointer)
        value.align = align
        return value

    def store(self, argument: int, index: Any, value: Any) -> None:
        pointer, align = self._place(argument, index, value.type)
        self.builder.store(value, pointer).align = align

    def _place(self, argument: int, index: Any, kind: Any) -> tuple[Any, int]:
        array = self.kinds[argument]
        data = self.context.make_array(array)(self.context, self.builder, self.args[argument]).data
        index = self.number(index) if isinstance(index, int) else index
        pointer = self.builder.bitcast(self.builder.gep(data, [index]), kind.as_pointer())
        return pointer, array.dtype.bitwidth // 8

    def variable(self, initial: Any) -> Any:
        """Something that can be read and written; LLVM keeps it in registers."""
        return cgutils.alloca_once_value(self.builder, initial)

    def zeros(self, vector: Any) -> Any:
        variable = cgutils.alloca_once(self.builder, vector)
        self.builder.store(_constant(vector, 0), variable)
        return variable

    def increase(self, variable: Any, value: Any) -> None:
        self.builder.store(self.add(self.builder.load(variable), value), variable)

    def everywhere(self, value: Any, vector: Any) -> Any:
        """A vector of equal numbers."""
        first = self.builder.insert_element(
            ir.Constant(vector, ir.Undefined), value, ir.Constant(_I32, 0)
        )
        mask = _constant(ir.VectorType(_I32, vector.count), 0)
        return self.builder.shuffle_vector(first, first, mask)

    def even_odd(self, shorts: Any) -> list[Any]:
        """16-bit numbers as two vectors of 32-bit ones."""
        pairs = self.builder.bitcast(shorts, _INTS)
        return [
            self.builder.and_(pairs, _constant(_INTS, 0xFFFF)),
            self.builder.lshr(pairs, _constant(_INTS, 16)),
        ]

    def copy(self, pixels: int, copies: int, next_copy: Any, gathered: int, place: Any) -> None:
        """Carry out the copy that the variable `next_copy` names; it and `place` move on."""
        index = self.builder.load(next_copy)
        width = ir.IntType(self.kinds[copies].dtype.bitwidth)
        number = self.builder.zext(self.load(copies, index, width), _I64)
        source = self.builder.lshr(number, self.number(ADVANCE_BITS))
        value = self.load(pixels, source, _BLOCK)
        self.store(gathered, self.builder.load(place), value)
        self.increase(place, self.builder.and_(number, self.number((1 << ADVANCE_BITS) - 1)))
        self.increase(next_copy, self.number(1))


def _constant(vector: Any, value: int) -> Any:
    return ir.Constant(vector, [value] * vector.count)


@_operation
def gather(
    _typing: Any, pixels: Any, copies: Any, first: Any, end: Any, gathered: Any, to: Any
) -> Any:
    """Gather a block's grey values, or what is left of them.

    Parameters
    ----------
    pixels : uint8, contiguous
        The image in scan order, with zeros behind it.
    copies : uint32 or uint64, contiguous
        The table's copies (see `lut.DiscTable`).
    first, end : uint64
        Those to be carried out: a multiple of `GROUP`.
    gathered : uint8, contiguous
        Result: rows of `BLOCK` grey values.
    to : uint64
        Index in `gathered` at which they begin.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        next_copy, place = code.variable(args[2]), code.variable(args[5])
        groups = builder.udiv(code.sub(args[3], args[2]), code.number(GROUP))
        with cgutils.for_range(builder, groups):
            # A group at a time: the end of a loop is what a processor foresees least.
            for _ in range(GROUP):
                code.copy(0, 1, next_copy, 4, place)
        return context.get_dummy_value()

    result = types.void(pixels, copies, types.uint64, types.uint64, gathered, types.uint64)
    return result, generate


@_operation
def sum_and_gather(
    _typing: Any,
    pixels: Any,
    copies: Any,
    first: Any,
    gathered: Any,
    to: Any,
    read: Any,
    groups: Any,
    sums: Any,
    products: Any,
) -> Any:
    """Sum over one block's gathered grey values, and begin to gather those of another.

    One keeps a processor's arithmetic busy, the other its ways to memory, so they take turns.

    Parameters
    ----------
    pixels, copies, first, gathered, to
        As in `gather`. ``LEAST_COPIES * groups`` copies are carried out.
    read : uint64
        Index in `gathered` at which the block to be summed begins.
    groups : uint64
        Groups of `GROUP` rows in each of its two outlines.
    sums : (2, BLOCK) uint16, contiguous
        Result: sums x of the inner and the outer outline.
    products : (2, BLOCK / 2) uint32, contiguous
        Result: sums of x (255 - x) of both outlines, for the even and for the odd centres.

    Returns
    -------
    uint64
        Index in `gathered` to which the next copy goes.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        next_copy, place, row = (
            code.variable(args[2]),
            code.variable(args[4]),
            code.variable(args[5]),
        )
        outline_size = code.mul(args[6], code.number(GROUP * BLOCK))
        grey = [[code.zeros(_SHORTS) for _ in _PARTS] for _ in range(2)]
        # Sums of products of even and odd pixels at once, modulo 2^32, and of the odd ones alone.
        both = [code.zeros(_INTS) for _ in _PARTS]
        odd = [code.zeros(_INTS) for _ in _PARTS]
        with cgutils.for_range(builder, args[6]):
            for _ in range(LEAST_COPIES):
                code.copy(0, 1, next_copy, 3, place)
            inner = builder.load(row)
            for outline, begin in enumerate((inner, code.add(inner, outline_size))):
                for part in _PARTS:
                    x, product = [], []
                    for k in range(GROUP):
                        index = code.add(begin, code.number(k * BLOCK + part * LANES))
                        x.append(builder.zext(code.load(3, index, _BYTES), _SHORTS))
                        # 255 - x is x with its 8 bits turned round.
                        complement = builder.xor(x[k], _constant(_SHORTS, 255))
                        product.append(code.mul(x[k], complement))
                    code.increase(grey[outline][part], reduce(code.add, x))
                    pairs = builder.bitcast(reduce(code.add, product), _INTS)
                    code.increase(both[part], pairs)
                    code.increase(odd[part], builder.lshr(pairs, _constant(_INTS, 16)))
            code.increase(row, code.number(GROUP * BLOCK))
        for part in _PARTS:
            for outline in range(2):
                code.store(7, outline * BLOCK + part * LANES, builder.load(grey[outline][part]))
            of_odd = builder.load(odd[part])
            shifted = builder.shl(of_odd, _constant(_INTS, 16))
            of_even = code.sub(builder.load(both[part]), shifted)
            for parity, value in enumerate((of_even, of_odd)):
                code.store(8, (parity * BLOCK + part * LANES) // 2, value)
        return builder.load(place)

    result = types.uint64(
        pixels, copies, types.uint64, gathered, types.uint64, types.uint64, types.uint64, sums,
        products,
    )  # fmt: skip
    return result, generate


@_operation
def promising_all_vote(_typing: Any, sums: Any, products: Any, samples: Any, share: Any) -> Any:
    """Which centres of a block may have a quality of `share`, where all samples vote.

    Parameters
    ----------
    sums, products
        Of `sum_and_gather`.
    samples : uint32
        Samples on each outline.
    share : float32
        A little less than the least quality that matters: what is compared is as good as 32-bit
        numbers are, 4e-7.

    Returns
    -------
    uint64
        Bit i is set if ``difference^2 > share spread``, in the terms of
        `detect.discs.quality_kernels` with the number of samples cancelled.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        twice = builder.shl(args[2], ir.Constant(_I32, 1))
        n = code.everywhere(twice, _INTS)
        white = code.everywhere(code.mul(twice, ir.Constant(_I32, 255)), _INTS)
        least = code.everywhere(args[3], _FLOATS)

        def compare(inner: Any, outer: Any, product: Any, part: int, parity: int) -> Any:
            spread = _spread(code, code.add(inner, outer), product, n, white)
            difference = builder.sitofp(code.sub(inner, outer), _FLOATS)
            bound = builder.fmul(least, builder.sitofp(spread, _FLOATS))
            return builder.fcmp_ordered(">", builder.fmul(difference, difference), bound)

        return _mask(code, compare)

    return types.uint64(sums, products, types.uint32, types.float32), generate


@_operation
def promising(
    _typing: Any, sums: Any, products: Any, patterns: Any, pattern: Any, share: Any
) -> Any:
    """Which centres of a block may have a quality of `share`, where not all samples vote.

    Parameters
    ----------
    sums, products
        Of `sum_and_gather`.
    patterns : (P, 2, BLOCK) uint8, contiguous
        Votes of the inner and the outer outline.
    pattern : uint64
        Which of them.
    share : float32
        As in `promising_all_vote`.

    Returns
    -------
    uint64
        Bit i is set if ``difference^2 > share n_inner n_outer spread``.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        least = code.everywhere(args[4], _FLOATS)
        first = code.mul(args[3], code.number(2 * BLOCK))

        def votes(outline: int, part: int) -> list[Any]:
            index = code.add(first, code.number(outline * BLOCK + part * LANES))
            return code.even_odd(builder.zext(code.load(2, index, _BYTES), _SHORTS))

        def compare(inner: Any, outer: Any, product: Any, part: int, parity: int) -> Any:
            n_inner, n_outer = votes(0, part)[parity], votes(1, part)[parity]
            n = code.add(n_inner, n_outer)
            white = code.mul(n, _constant(_INTS, 255))
            spread = _spread(code, code.add(inner, outer), product, n, white)
            difference = builder.sitofp(
                code.sub(code.mul(n_outer, inner), code.mul(n_inner, outer)), _FLOATS
            )
            pairs = builder.fmul(least, builder.sitofp(code.mul(n_inner, n_outer), _FLOATS))
            bound = builder.fmul(pairs, builder.sitofp(spread, _FLOATS))
            return builder.fcmp_ordered(">", builder.fmul(difference, difference), bound)

        return _mask(code, compare)

    return types.uint64(sums, products, patterns, types.uint64, types.float32), generate


def _spread(code: _Code, total: Any, product: Any, n: Any, white: Any) -> Any:
    """Spread, n sum(x^2) - (sum x)^2, as sum x (255 n - sum x) - n sum(x (255 - x)).

    With up to 256 votes it is less than 2^30.
    """
    return code.sub(code.mul(total, code.sub(white, total)), code.mul(n, product))


def _mask(code: _Code, compare: Callable[[Any, Any, Any, int, int], Any]) -> Any:
    """A bit for each centre of a block; arguments 0 and 1 are the block's sums and products."""
    builder = code.builder
    mask = code.number(0)
    for part in _PARTS:
        inner, outer = (
            code.even_odd(code.load(0, outline * BLOCK + part * LANES, _SHORTS))
            for outline in range(2)
        )
        halves = []
        for parity, half in enumerate((0xFFFF, 0xFFFF0000)):
            product = code.load(1, (parity * BLOCK + part * LANES) // 2, _INTS)
            passed = compare(inner[parity], outer[parity], product, part, parity)
            halves.append(builder.select(passed, _constant(_INTS, half), _constant(_INTS, 0)))
        shorts = builder.bitcast(builder.or_(*halves), _SHORTS)
        bits = builder.icmp_unsigned("!=", shorts, _constant(_SHORTS, 0))
        number = builder.zext(builder.bitcast(bits, ir.IntType(LANES)), _I64)
        mask = builder.or_(mask, builder.shl(number, code.number(part * LANES)))
    return mask


@_operation
def vote(
    _typing: Any,
    gathered: Any,
    higher: Any,
    lower: Any,
    groups: Any,
    step: Any,
    outside: Any,
    least: Any,
    votes: Any,
    to: Any,
) -> Any:
    """In how many directions one outline's grey value exceeds the other's, centre by centre.

    Parameters
    ----------
    gathered : uint8, contiguous
        As in `sum_and_gather`.
    higher, lower : uint64
        Index in `gathered` at which the rows of the one outline, and of the other, begin.
    groups : uint64
        Groups of `GROUP` rows in each outline.
    step : uint8
        It has to exceed the other's by more than this, below 255.
    outside : uint8
        1: zeros of the lower outline, which are outside the image, are exceeded by nothing (and
        all else by one grey level more); 0: zeros are black.
    least : uint8
        Directions that matter, at least 1.
    votes : uint8, contiguous
        Result: `BLOCK` numbers of directions.
    to : uint64
        Index in `votes` at which they begin.

    Returns
    -------
    uint64
        Bit i is set if centre i has at least `least` directions.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        above, below = code.variable(args[1]), code.variable(args[2])
        next_step = builder.add(args[4], ir.Constant(_I8, 1))
        enough = code.everywhere(next_step, _BLOCK)
        shift = code.everywhere(args[5], _BLOCK)
        count = code.zeros(_BLOCK)
        with cgutils.for_range(builder, args[3]):
            for k in range(GROUP):
                x, y = (
                    code.load(0, code.add(builder.load(row), code.number(k * BLOCK)), _BLOCK)
                    for row in (above, below)
                )
                y = code.sub(y, shift)
                more = builder.icmp_unsigned(">", x, y)
                # A saturating difference, in a form that LLVM knows as such.
                difference = builder.select(more, code.sub(x, y), _constant(_BLOCK, 0))
                votes_for = builder.icmp_unsigned(">=", difference, enough)
                # True is -1.
                code.increase(
                    count, code.sub(_constant(_BLOCK, 0), builder.sext(votes_for, _BLOCK))
                )
            for row in (above, below):
                code.increase(row, code.number(GROUP * BLOCK))
        total = builder.load(count)
        code.store(7, args[8], total)
        bits = builder.icmp_unsigned(">=", total, code.everywhere(args[6], _BLOCK))
        return builder.bitcast(bits, _I64)

    result = types.uint64(
        gathered, types.uint64, types.uint64, types.uint64, types.uint8, types.uint8, types.uint8,
        votes, types.uint64,
    )  # fmt: skip
    return result, generate


@_operation
def lowest_bit(_typing: Any, mask: Any) -> Any:
    """Position of the lowest bit that is set in a uint64 that is not 0."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate
