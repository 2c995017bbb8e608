"""Reads untrusted files in NumPy's ``.npy`` format: no objects, and sizes are checked first."""

from __future__ import annotations

import math
import tokenize
import warnings
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from redetect.storage.messages import one_line


def read_plain_array(
    stream: BinaryIO, dtype: np.dtype[Any], dimensions: int, largest_bytes: int
) -> NDArray[Any]:
    """Read an array of a known type from a stream, to the array's end.

    Arrays of more bytes than `largest_bytes` are refused before memory is taken. Raises a
    ValueError that says on one line what was found instead.
    """
    expected = f"expected {dimensions}-dimensional {dtype}, row by row"
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version} of its header is not known")
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # headers that Python 2 wrote are not guessed at
            shape, fortran, stored = read(stream)
        if stored.hasobject or stored != dtype or len(shape) != dimensions or fortran:
            raise ValueError(f"it is {stored} of shape {shape}")
        size = dtype.itemsize * math.prod(shape)
        if min(shape, default=0) < 0 or size > largest_bytes:
            raise ValueError(f"its shape {shape} does not fit in {largest_bytes} bytes")
        data = stream.read(size)
    # A damaged header can raise almost any exception.
    except (
        ValueError, SyntaxError, TypeError, OverflowError, EOFError, MemoryError, RecursionError,
        tokenize.TokenError, Warning,
    ) as error:  # fmt: skip
        said = one_line(str(error).partition("\n")[0] or type(error).__name__, 200)
        raise ValueError(f"{said}: {expected}") from None
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes of data: expected {size}: {expected}")
    return np.frombuffer(bytearray(data), dtype=dtype).reshape(shape)
