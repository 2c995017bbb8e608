"""Compiled: rows of numbers as C's ``%g`` writes them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.uncounted import uncounted

#: Powers of ten that a double holds exactly.
_POWERS = np.array([10.0**k for k in range(23)])
_DIGITS = 6
_LEAST, _MOST = 10.0 ** (_DIGITS - 1), 10.0**_DIGITS
#: A product with a power of ten is off by some 1e-10 of a last digit; what is farther than this
#: from the middle between two digits is rounded right.
_DOUBTFUL = 1e-7

_ZERO, _POINT, _MINUS, _PLUS, _SPACE, _E = (ord(c) for c in "0.-+ e")
#: "00" to "99", one after the other.
_PAIRS = np.array([_ZERO + digit for n in range(100) for digit in divmod(n, 10)], np.uint8)
_TEN, _HUNDRED, _MYRIAD = np.uint32(10), np.uint32(100), np.uint32(10_000)

#: Most bytes of a number and the space before it.
LONGEST = 14


@uncounted
def _significant_digits(size: float) -> tuple[int, int]:
    """The 6 digits of a number above 0 as an integer, and the exponent of the first; -1 if unsure.

    The digits are 100000 to 999999.
    """
    # Mostly a few steps: less than a logarithm takes.
    exponent = 0
    if size < 1.0:
        first = size
        while first < 1.0 and exponent > _DIGITS - len(_POWERS):
            exponent -= 1
            first = size * _POWERS[-exponent]
    else:
        while exponent < len(_POWERS) - 1 and size >= _POWERS[exponent + 1]:
            exponent += 1
    power = _DIGITS - 1 - exponent
    scaled = size * _POWERS[power] if power >= 0 else size / _POWERS[-power]
    digits = math.floor(scaled)
    rest = scaled - digits
    if not _LEAST <= scaled < _MOST or abs(rest - 0.5) < _DOUBTFUL:
        return -1, 0
    number = int(digits) + (1 if rest > 0.5 else 0)
    if number == 1000000:
        return 100000, exponent + 1
    return number, exponent


@uncounted
def _write_number(value: float, text: NDArray[np.uint8], at: int) -> int:
    """Write a number; returns where it ends, -1 if its digits are not sure."""
    if math.copysign(1.0, value) < 0.0:
        text[at] = _MINUS
        at += 1
    if value == 0.0:
        text[at] = _ZERO
        return at + 1
    number, exponent = _significant_digits(abs(value))
    if number < 0:
        return -1
    first = np.uint32(number) // _MYRIAD
    last = np.uint32(number) - first * _MYRIAD
    middle = last // _HUNDRED
    last -= middle * _HUNDRED
    count = _DIGITS  # without the zeros at the end
    if last == 0:
        count = 4
        if middle == 0:
            count = 2 if first % _TEN != 0 else 1
        elif middle % _TEN == 0:
            count = 3
    elif last % _TEN == 0:
        count = 5
    scientific = exponent < -4 or exponent >= _DIGITS
    # Digits before the point; none at all is a zero.
    whole = 1 if scientific else exponent + 1
    if whole <= 0:
        text[at] = _ZERO
        text[at + 1] = _POINT
        at += 2
        for _ in range(-whole):
            text[at] = _ZERO
            at += 1
        whole = 0
    for k in range(2):  # all of them, whether or not they stay
        text[at + k] = _PAIRS[2 * first + k]
        text[at + 2 + k] = _PAIRS[2 * middle + k]
        text[at + 4 + k] = _PAIRS[2 * last + k]
    if 0 < whole < count:
        for k in range(count, whole, -1):
            text[at + k] = text[at + k - 1]
        text[at + whole] = _POINT
        at += count + 1
    else:
        at += max(count, whole)
    if scientific:
        text[at] = _E
        text[at + 1] = _MINUS if exponent < 0 else _PLUS
        size = abs(exponent)
        text[at + 2] = _ZERO + size // 10
        text[at + 3] = _ZERO + size % 10
        at += 4
    return at


@njit(cache=True, error_model="numpy", nogil=True)
def circle_numbers(
    floor_xy: NDArray[np.float64], quality: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The (N, 6) numbers of rows of discs: x, y, quality, cxx, cxy, cyy."""
    numbers = np.empty((len(quality), 6))
    for i in range(len(quality)):
        numbers[i, 0] = floor_xy[i, 0]
        numbers[i, 1] = floor_xy[i, 1]
        numbers[i, 2] = quality[i]
        numbers[i, 3] = covariance[i, 0, 0]
        numbers[i, 4] = covariance[i, 0, 1]
        numbers[i, 5] = covariance[i, 1, 1]
    return numbers


@njit(cache=True, error_model="numpy", nogil=True)
def line_numbers(lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """The (N, 8) numbers of rows of lines: ends, alpha, beta, quality, sigma."""
    numbers = np.empty((lines.shape[1], 8))
    for i in range(lines.shape[1]):
        for j in range(6):
            numbers[i, j] = lines[j, i]
        numbers[i, 6] = 0.0
        numbers[i, 7] = lines[6, i]
    return numbers


@uncounted
def write_rows(
    head: NDArray[np.uint8],
    numbers: NDArray[np.float64],
    tail: NDArray[np.uint8],
    text: NDArray[np.uint8],
) -> int:
    """Write rows: the head, the numbers with a space before each, the tail.

    Parameters
    ----------
    head, tail : (A,), (B,) uint8
    numbers : (N, K) float64
    text : (N * (A + K * LONGEST + B),) uint8
        Result.

    Returns
    -------
    int
        How many bytes there are; -1 if a number is not finite, or is so close to the middle between
        two numbers of 6 digits, so large or so small that this arithmetic cannot tell its digits.
    """
    at = 0
    for i in range(numbers.shape[0]):
        for k in range(len(head)):
            text[at + k] = head[k]
        at += len(head)
        for j in range(numbers.shape[1]):
            value = numbers[i, j]
            if not math.isfinite(value):
                return -1
            text[at] = _SPACE
            at = _write_number(value, text, at + 1)
            if at < 0:
                return -1
        for k in range(len(tail)):
            text[at + k] = tail[k]
        at += len(tail)
    return at


@njit(cache=True, error_model="numpy", nogil=True)
def write_circle_rows(
    head: NDArray[np.uint8],
    floor_xy: NDArray[np.float64],
    quality: NDArray[np.float64],
    covariance: NDArray[np.float64],
    tail: NDArray[np.uint8],
    text: NDArray[np.uint8],
) -> int:
    """`write_rows` of `circle_numbers`: one call takes a microsecond less than two."""
    return write_rows(head, circle_numbers(floor_xy, quality, covariance), tail, text)


@njit(cache=True, error_model="numpy", nogil=True)
def write_line_rows(
    head: NDArray[np.uint8],
    lines: NDArray[np.float64],
    tail: NDArray[np.uint8],
    text: NDArray[np.uint8],
) -> int:
    """`write_rows` of `line_numbers`."""
    return write_rows(head, line_numbers(lines), tail, text)
