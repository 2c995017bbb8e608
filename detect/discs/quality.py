"""The quality of every centre: how well two outlines on the floor part the grey values.

A disc centred at a pixel has an inner outline within its edge and an outer one beyond it
(`lut.outlines`). Taken as two classes, their grey values have Otsu's quality (N. Otsu, A Threshold
Selection Method from Gray-Level Histograms, 1979; DLR Spatial Cognition data set report, circle
detection): the between-class variance over the total one. With n = n_inner + n_outer samples that
vote,

    difference = n_outer sum(inner) - n_inner sum(outer)
    spread     = n sum(x^2) - (sum x)^2
    quality    = difference^2 / (n_inner n_outer spread)
    contrast   = difference / (n_inner n_outer)

All of these are whole numbers, so the only rounding is that of the one final division. Squares are
summed by way of a grey value times its complement, x (255 - x): four of these fit into 16 bits, and
x^2 = 255 x - x (255 - x).

Something bright or dark beside a disc raises the total variance, and so ruins the quality, but not
the steps of the grey value from outline to outline. So, if asked to, directions vote: those in
which the inner grey value exceeds the outer one (or the other way round) by some grey levels.

The compiled loops are written so that LLVM turns them into vectors: simple indices, and NumPy's
functions in place of operators where Numba would widen numbers to 64 bits.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from detect.errors import FrameError
from lut import DiscTable
from lut.kernels import ADVANCE_BITS, AT_ONCE, COPIED, GROUP, LARGEST_STRIDE, PITCH

#: A centre that was found.
CENTRE = np.dtype(
    [
        ("u", np.int64),
        ("v", np.int64),
        ("quality", np.float64),
        # Of the inner outline to the outer; where votes alone count, at least the step of their
        # sign.
        ("contrast", np.float32),
        # The quality; where votes alone count their share of all, scaled to less than the
        # least quality.
        ("score", np.float64),
    ]
)

#: Comparisons of 24-bit numbers let through a little more than the exact ones that follow.
_CAUTIOUS = 1.0 - 4e-6
#: Centres for which there is room at first.
_ROOM = 2048

_U8, _U16, _U32, _U64, _I32, _F32 = (
    np.uint8, np.uint16, np.uint32, np.uint64, np.int32, np.float32,
)  # fmt: skip
#: Centres that are summed at once.
TILE = 64
#: From one row of gathered grey values to the next.
_ROW = np.uint64(PITCH)


class Wanted(NamedTuple):
    """Which centres are found."""

    quality: float
    """At least, and above 0;"""
    contrast: float
    """and more than this, of either sign, grey levels (or 4e-6 of it less)."""
    sign: float
    """1 for those lighter than what is around them, -1 for darker ones, 0 for both."""
    step: int
    """Directions vote whose grey value steps by more than this, below 255."""
    votes: int
    """With at least so many votes of the sign, low quality does not matter; 0: it does."""


class Blocks(NamedTuple):
    """A `lut.DiscTable` as compiled loops take it."""

    samples: int
    copies: NDArray[Any]
    bounds: NDArray[np.int64]
    row: NDArray[np.int32]
    column: NDArray[np.int32]
    stride: NDArray[np.int32]
    whole: NDArray[np.bool_]
    place: NDArray[np.int64]
    votes: NDArray[np.uint8]


class Memory(NamedTuple):
    """What is summed for the centres of a block."""

    gathered: NDArray[np.uint8]
    inner: NDArray[np.uint16]
    outer: NDArray[np.uint16]
    products: NDArray[np.uint32]
    matters: NDArray[np.uint8]
    light: NDArray[np.uint8]
    dark: NDArray[np.uint8]


class _Code:
    """Instructions on the arrays that are arguments of an operation."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.builder, self.args, self.kinds = builder, args, signature.args
        self.data = [
            context.make_array(kind)(context, builder, value).data
            if isinstance(kind, types.Array)
            else None
            for kind, value in zip(signature.args, args)
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

    def increase(self, variable: Any, value: Any) -> None:
        self.builder.store(self.builder.add(self.builder.load(variable), value), variable)

    def carry_out(self, first: Any, count: Any, place: Any) -> None:
        """Carry out some copies: arguments 0 to 3 are those of `gather`, `place` is a variable."""
        builder = self.builder
        done = builder.append_basic_block("done")
        strides = builder.switch(self.args[2], done)
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
                    self.store(3, builder.load(place), builder.shuffle_vector(grey, grey, these))
                    low = _number((1 << ADVANCE_BITS) - 1)
                    self.increase(place, builder.and_(copy, low))
            builder.branch(done)
        builder.position_at_end(done)


_I64 = ir.IntType(64)
_BYTES, _SHORTS = (ir.VectorType(ir.IntType(bits), 32) for bits in (8, 16))
_INTS = ir.VectorType(ir.IntType(32), 16)


def _number(value: int) -> Any:
    return ir.Constant(_I64, value)


def _gather(
    _typing: Any, pixels: Any, copies: Any, stride: Any, gathered: Any, first: Any, count: Any,
    to: Any,
) -> Any:  # fmt: skip
    """Carry out some copies, one after the other.

    As loops these are not turned into vectors: an image and what is gathered from it might overlap.

    Parameters
    ----------
    pixels : (H W + 64,) uint8
        The image in scan order, and zeros.
    copies : (N,) uint32 or uint64
        See `lut.DiscTable`.
    stride : int64
    gathered : uint8
        Result: rows of 256 grey values, one for each sample; and 64 bytes to spare.
    first, count : int64
        Which of the copies.
    to : int64
        Index in `gathered` at which they begin.

    Returns
    -------
    int64
        Index at which the next copy begins.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = cgutils.alloca_once_value(builder, args[6])
        _Code(context, builder, signature, args).carry_out(args[4], args[5], place)
        return builder.load(place)

    i64 = types.int64
    return i64(pixels, copies, i64, gathered, i64, i64, i64), generate


def _sum_tile(
    _typing: Any, pixels: Any, copies: Any, stride: Any, gathered: Any, first: Any, each: Any,
    to: Any, row: Any, groups: Any, column: Any, inner: Any, outer: Any, products: Any,
) -> Any:  # fmt: skip
    """Sums for 64 centres, and meanwhile some copies: `each` after every 8 rows.

    One keeps a processor's arithmetic busy, the other its ways to memory, so they take turns.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = _Code(context, builder, signature, args)
        place = cgutils.alloca_once_value(builder, args[6])
        zeros = [ir.Constant(kind, [0] * kind.count) for kind in (_SHORTS, _INTS)]
        grey = [[cgutils.alloca_once_value(builder, zeros[0]) for _ in range(2)] for _ in range(2)]
        sums = [[cgutils.alloca_once_value(builder, zeros[1]) for _ in range(2)] for _ in range(2)]
        turned = ir.Constant(_SHORTS, [255] * 32)
        halves = [
            ir.Constant(ir.VectorType(ir.IntType(32), 16), list(range(k, k + 16))) for k in (0, 16)
        ]
        with cgutils.for_range(builder, args[8]) as loop:
            of_inner = builder.add(
                builder.add(args[7], args[9]), builder.mul(loop.index, _number(4 * PITCH))
            )
            of_outer = builder.add(of_inner, builder.mul(args[8], _number(4 * PITCH)))
            for outline, begin in enumerate((of_inner, of_outer)):
                for part in range(2):
                    x, product = [], []
                    for k in range(4):
                        index = builder.add(begin, _number(k * PITCH + 32 * part))
                        x.append(builder.zext(code.load(3, index, _BYTES), _SHORTS))
                        product.append(builder.mul(x[k], builder.xor(x[k], turned)))
                    code.increase(grey[outline][part], reduce(builder.add, x))
                    four = reduce(builder.add, product)
                    for half in range(2):
                        some = builder.shuffle_vector(four, four, halves[half])
                        code.increase(sums[part][half], builder.zext(some, _INTS))
            done = builder.add(args[4], builder.mul(loop.index, args[5]))
            code.carry_out(done, args[5], place)
        for part in range(2):
            for outline in range(2):
                index = builder.add(args[9], _number(32 * part))
                code.store(10 + outline, index, builder.load(grey[outline][part]))
            for half in range(2):
                index = builder.add(args[9], _number(32 * part + 16 * half))
                code.store(12, index, builder.load(sums[part][half]))
        return builder.load(place)

    i64 = types.int64
    result = i64(
        pixels, copies, i64, gathered, i64, i64, i64, i64, i64, i64, inner, outer, products
    )
    return result, generate


#: The same without their first arguments.
gather: Callable[..., int] = intrinsic(_gather)
_sum_of_tile: Callable[..., int] = intrinsic(_sum_tile)


@njit(cache=True, error_model="numpy", nogil=True)
def sum_and_gather(
    memory: Memory, place: int, samples: int, width: int, pixels: NDArray[np.uint8],
    blocks: Blocks, following: int, to: int,
) -> None:  # fmt: skip
    """Sums of x of both outlines, and of x (255 - x), of one block; and gather another.

    One keeps a processor's arithmetic busy, the other its ways to memory, so they take turns.

    Parameters
    ----------
    memory : Memory
    place, to : int
        Where the one block's grey values begin, and the other's are to.
    samples, width : int
        Samples on each outline, and centres of the block that is summed.
    pixels, blocks
        As in `find_centres`.
    following : int
        Number of the block to be gathered; -1 for none.
    """
    fours = -(-samples // GROUP) * (GROUP // 4)
    first = end = np.int64(0)
    stride = np.int64(1)
    if following >= 0:
        first, end = blocks.bounds[following], blocks.bounds[following + 1]
        stride = np.int64(blocks.stride[following])
    tiles = -(-width // TILE)
    each = (end - first) // (fours * tiles * AT_ONCE) * AT_ONCE
    for tile in range(tiles):
        to = _sum_of_tile(
            pixels, blocks.copies, stride, memory.gathered, first, each, to, np.int64(place),
            fours, np.int64(tile * TILE), memory.inner, memory.outer, memory.products,
        )  # fmt: skip
        first += each * fours
    gather(pixels, blocks.copies, stride, memory.gathered, first, end - first, to)


@njit(cache=True, error_model="numpy", nogil=True)
def compare_whole(memory: Memory, samples: int, width: int, wanted: Wanted) -> None:
    """As `compare`, where all samples vote: their number is cancelled."""
    least = _F32(wanted.contrast * _CAUTIOUS) * _F32(samples)
    share = _F32(wanted.quality * _CAUTIOUS)
    n, white = _I32(2 * samples), _I32(2 * samples * 255)
    inner, outer, products, matters = memory.inner, memory.outer, memory.products, memory.matters
    for i in range(_U64(width)):
        a, b = _I32(inner[i]), _I32(outer[i])
        total = np.add(a, b)
        difference = _F32(np.subtract(a, b))
        spread = _F32(
            np.subtract(
                np.multiply(total, np.subtract(white, total)),
                np.multiply(n, _I32(products[i])),
            )
        )
        matters[i] = (abs(difference) > least) & (difference * difference > share * spread)


@njit(cache=True, error_model="numpy", nogil=True)
def compare(
    memory: Memory, votes: NDArray[np.uint8], place: int, width: int, wanted: Wanted
) -> None:
    """Note which centres may have the contrast and the quality wanted, in 32-bit numbers."""
    least = _F32(wanted.contrast * _CAUTIOUS)
    share = _F32(wanted.quality * _CAUTIOUS)
    of_inner, of_outer = _U64(place), _U64(place + len(votes) // 2)
    inner, outer, products, matters = memory.inner, memory.outer, memory.products, memory.matters
    for i in range(_U64(width)):
        n_inner, n_outer = _I32(votes[of_inner + i]), _I32(votes[of_outer + i])
        a, b = _I32(inner[i]), _I32(outer[i])
        n, total = np.add(n_inner, n_outer), np.add(a, b)
        white = np.multiply(_I32(255), n)
        difference = _F32(np.subtract(np.multiply(n_outer, a), np.multiply(n_inner, b)))
        # At most 256 votes: none of these exceeds 2^30.
        spread = _F32(
            np.subtract(
                np.multiply(total, np.subtract(white, total)),
                np.multiply(n, _I32(products[i])),
            )
        )
        pairs = _F32(np.multiply(n_inner, n_outer))
        matters[i] = (abs(difference) > least * pairs) & (
            difference * difference > share * pairs * spread
        )


@njit(cache=True, error_model="numpy", forceinline=True)
def _count_steps(
    gathered: NDArray[np.uint8], higher: Any, lower: Any, steps: tuple[int, int], width: Any,
    counts: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Count where one row of samples exceeds another by a step."""
    enough, outside = _U8(steps[0]), _U8(steps[1])
    for i in range(width):
        x = _U8(gathered[higher + i])
        y = np.subtract(_U8(gathered[lower + i]), outside)
        more = np.subtract(np.maximum(x, y), y)
        counts[i] += more >= enough


@njit(cache=True, error_model="numpy", nogil=True)
def vote(
    memory: Memory, place: int, samples: int, width: int, wanted: Wanted, some_outside: bool
) -> None:
    """Count the directions that vote, and note where there are enough.

    Zeros of the outer outline may be outside the image. Then nothing exceeds them (and all else is
    exceeded by one grey level less).
    """
    light, dark = memory.light, memory.dark
    light[:width] = 0
    dark[:width] = 0
    padded = -(-samples // GROUP) * GROUP
    step = wanted.step + 1
    wide = _U64(width)
    for k in range(samples):
        inner = _U64(place) + _U64(k) * _ROW
        outer = inner + _U64(padded) * _ROW
        if wanted.sign >= 0.0:
            shift = 1 if some_outside else 0
            _count_steps(memory.gathered, inner, outer, (step, shift), wide, light)
        if wanted.sign <= 0.0:
            _count_steps(memory.gathered, outer, inner, (step, 0), wide, dark)
    for i in range(wide):
        memory.matters[i] |= max(light[i], dark[i]) >= wanted.votes


@njit(cache=True, error_model="numpy", nogil=True)
def quality_of(
    inner: float, outer: float, product: float, n_inner: float, n_outer: float
) -> tuple[float, float]:
    """Quality and contrast from the sums x of both outlines, x (255 - x) of all, and the votes.

    These are whole numbers, of which nothing here exceeds 2^53.
    """
    n = n_inner + n_outer
    total = inner + outer
    spread = n * (255.0 * total - product) - total * total
    difference = n_outer * inner - n_inner * outer
    pairs = n_inner * n_outer
    quality = (difference * difference) / (pairs * spread)
    contrast = difference / pairs
    return quality if spread > 0.0 else 0.0, contrast if pairs > 0.0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _judge(
    memory: Memory, i: int, n_inner: int, n_outer: int, samples: int, wanted: Wanted, centre: Any
) -> bool:
    """Quality, contrast and score of a centre, and whether it is wanted."""
    quality, contrast = quality_of(
        float(memory.inner[i]), float(memory.outer[i]), float(memory.products[i]),
        float(n_inner), float(n_outer),
    )  # fmt: skip
    centre.quality = centre.score = quality
    centre.contrast = contrast
    if quality >= wanted.quality and quality > 0.0 and contrast * wanted.sign >= 0.0:
        return True
    if wanted.votes == 0 or n_inner == 0:
        return False
    by_light = memory.light[i] >= wanted.votes
    count = memory.light[i] if by_light else memory.dark[i]
    least = wanted.step + 1.0
    centre.contrast = max(contrast, least) if by_light else min(contrast, -least)
    centre.score = wanted.quality / (samples + 1.0) * count
    return bool(count >= wanted.votes)


@njit(cache=True, error_model="numpy", nogil=True)
def memory_for(samples: int) -> Memory:
    """Memory for a block."""
    rows = 2 * -(-samples // GROUP) * GROUP
    return Memory(
        np.empty(2 * (rows * PITCH + COPIED), np.uint8),
        np.empty(PITCH, np.uint16),
        np.empty(PITCH, np.uint16),
        np.empty(PITCH, np.uint32),
        np.zeros(PITCH, np.uint8),
        np.zeros(PITCH, np.uint8),
        np.zeros(PITCH, np.uint8),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def find_centres(
    pixels: NDArray[np.uint8], blocks: Blocks, chosen: NDArray[np.int64], wanted: Wanted
) -> NDArray[Any]:
    """The centres wanted.

    Parameters
    ----------
    pixels : (H W + 64,) uint8
        The image in scan order, and zeros: a zero adds nothing to any sum.
    blocks : Blocks
    chosen : (N,) int64
        Which blocks are looked at.
    wanted : Wanted

    Returns
    -------
    (M,) CENTRE
        In the order of the blocks.
    """
    samples = blocks.samples
    memory = memory_for(samples)
    eights = memory.matters.view(np.uint64)
    votes = blocks.votes.reshape(-1)
    of_outer = blocks.votes.shape[1]
    found = np.empty(_ROOM, CENTRE)
    count = 0
    half = len(memory.gathered) // 2
    nothing = np.int64(-1)
    if len(chosen) > 0:
        b = chosen[0]
        gather(
            pixels, blocks.copies, np.int64(blocks.stride[b]), memory.gathered, blocks.bounds[b],
            blocks.bounds[b + 1] - blocks.bounds[b], np.int64(0),
        )  # fmt: skip
    for n in range(len(chosen)):
        b = chosen[n]
        place = blocks.place[b]
        width = blocks.place[b + 1] - place
        stride = blocks.stride[b]
        # There are two places for grey values, used alternately.
        here = (n % 2) * half
        following = chosen[n + 1] if n + 1 < len(chosen) else nothing
        sum_and_gather(memory, here, samples, width, pixels, blocks, following, half - here)
        if blocks.whole[b]:
            compare_whole(memory, samples, width, wanted)
        else:
            compare(memory, votes, place, width, wanted)
        if wanted.votes > 0:
            vote(memory, here, samples, width, wanted, not blocks.whole[b])
        if count + width > len(found):
            more = np.empty(2 * len(found), CENTRE)
            more[:count] = found[:count]
            found = more
        for k in range(width // 8):
            if eights[k] == 0:
                continue
            for i in range(8 * k, 8 * k + 8):
                if memory.matters[i] and _judge(
                    memory, i, votes[place + i], votes[place + of_outer + i], samples, wanted,
                    found[count],
                ):  # fmt: skip
                    found[count].u = blocks.column[b] + stride * i
                    found[count].v = blocks.row[b]
                    count += 1
    return found[:count]


_kept = threading.local()


def with_zeros(image: NDArray[np.uint8], table: DiscTable) -> NDArray[np.uint8]:
    """The image's pixels, with the zeros that the table wants behind them.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable

    Returns
    -------
    (H W + 64,) uint8
        In scan order; only those pixels from the first on that the table refers to. It is the
        calling thread's, until it asks again: memory that is new for every image has to be fetched.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    expected = table.floor_xy.shape[:2]
    if image.shape != expected or image.dtype != np.uint8:
        raise FrameError(
            f"the image is {image.dtype} of shape {image.shape}: the table is for uint8 of shape "
            f"{expected}"
        )
    pixels: NDArray[np.uint8] | None = getattr(_kept, "pixels", None)
    if pixels is None or len(pixels) != image.size + COPIED:
        pixels = _kept.pixels = np.zeros(image.size + COPIED, np.uint8)
    first = table.first_source
    pixels[first : image.size] = image.reshape(-1)[first:]
    return pixels


def blocks_of(table: DiscTable) -> Blocks:
    """The table as compiled loops take it."""
    return Blocks(
        table.samples, table.copies, table.block_copies, table.block_row, table.block_column,
        table.block_stride, table.block_whole, table.block_votes, table.votes,
    )  # fmt: skip


def quality_of_centres(
    image: NDArray[np.uint8], table: DiscTable
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Otsu's quality, and the contrast, of the outlines around every pixel.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable
        The camera's table.

    Returns
    -------
    quality : (H, W) float64
        Between-class variance / total variance of the outlines' grey values, 0 to 1; 0 where the
        table has no usable centre.
    contrast : (H, W) float32
        Mean grey value of the inner outline minus that of the outer.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    every = np.arange(len(table.block_row))
    found = find_centres(
        with_zeros(image, table), blocks_of(table), every, Wanted(0.0, 0.0, 0.0, 0, 0)
    )
    quality, contrast = np.zeros(image.shape), np.zeros(image.shape, np.float32)
    quality[found["v"], found["u"]] = found["quality"]
    contrast[found["v"], found["u"]] = found["contrast"]
    return quality, contrast
