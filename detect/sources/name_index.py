"""Index of names and their positions, for runs of a million frames."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

_LONGEST = 64


class NameIndex:
    """Finds the place of a name in a sequence; costs the width of the longest name and 4 bytes.

    Parameters
    ----------
    names : iterable of bytes
        Without NUL; longer ones than 64 bytes are known by their digest. Of equal ones the last
        counts.
    """

    def __init__(self, names: Iterable[bytes]) -> None:
        keys: NDArray[np.bytes_] = np.array([_key(name) for name in names], dtype=np.bytes_)
        order = np.argsort(keys, kind="stable")
        self._keys = keys[order]
        self._places = order.astype(np.uint32)
        self._next = 0  # in a run, after a name mostly comes its successor

    def __len__(self) -> int:
        return len(self._keys)

    def find(self, name: bytes) -> int | None:
        """The place of a name in the sequence; None if it is not there."""
        key = _key(name)
        keys = self._keys
        # For a wider needle numpy would copy the whole haystack to its width.
        if not len(keys) or len(key) > keys.itemsize:
            return None
        after = self._next + 1
        if after >= len(keys) or keys.item(after - 1) != key or keys.item(after) == key:
            after = int(keys.searchsorted(np.bytes_(key), side="right"))
            if not after or keys.item(after - 1) != key:
                return None
        self._next = after
        return self._places.item(after - 1)


def _key(name: bytes) -> bytes:
    return name if len(name) < _LONGEST else hashlib.sha256(name).hexdigest().encode()
