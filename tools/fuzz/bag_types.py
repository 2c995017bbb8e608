"""Bags opened faster: once for all questions, and their messages' types worked out once.

The package rosbags parses the definitions that a bag brings and makes classes of them whenever the
bag is opened, which takes a hundred times as long as all else. Where they are what they were, so
is the result; definitions that are new go the whole way.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar
from unittest.mock import patch

if TYPE_CHECKING:
    from pathlib import Path

    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

_SETS = 64


@contextmanager
def opened_once(path: Path) -> Iterator[None]:
    """Open a bag once for all that asks for it within; what it gives is the same every time."""
    from detect.sources import bag

    with bag.opened_bag(path) as reader:

        @contextmanager
        def opened(_: Path) -> Iterator[AnyReader]:
            yield reader

        with patch.object(bag, "opened_bag", opened):
            yield


@contextmanager
def known_types() -> Iterator[None]:
    """Remember types while bags are opened within."""
    from rosbags import typesys
    from rosbags.highlevel import anyreader

    made, parsed = _remembering()
    with (
        patch.object(anyreader, "get_types_from_msg", parsed),
        patch.object(anyreader, "get_typestore", lambda _: _Types()),
        patch.object(typesys, "get_typestore", made),
    ):
        yield


@lru_cache(maxsize=1)
def _remembering() -> tuple[Any, Any]:
    from rosbags.typesys import get_types_from_msg
    from rosbags.typesys.stores import get_typestore

    return lru_cache(maxsize=8)(get_typestore), lru_cache(maxsize=4 * _SETS)(get_types_from_msg)


class _Types:
    """An empty store of types that becomes the one which these types were put into before."""

    _known: ClassVar[dict[Any, tuple[Typestore, dict[str, str], dict[str, Any]]]] = {}

    def __init__(self) -> None:
        self._store: Any = None
        self._hashes: dict[str, str] = {}
        self._definitions: dict[str, Any] = {}

    def register(self, types: dict[str, Any]) -> None:
        from rosbags.typesys import Stores
        from rosbags.typesys.stores import get_typestore

        key = tuple((name, repr(meaning)) for name, meaning in types.items())
        if key not in self._known:
            store = get_typestore(Stores.EMPTY)
            store.register(types)
            if len(self._known) >= _SETS:
                self._known.pop(next(iter(self._known)))
            self._known[key] = store, {}, {}
        self._store, self._hashes, self._definitions = self._known[key]

    def hash_rihs01(self, name: str) -> str:
        if name not in self._hashes:
            self._hashes[name] = self._store.hash_rihs01(name)
        return self._hashes[name]

    def generate_msgdef(self, name: str) -> Any:
        if name not in self._definitions:
            self._definitions[name] = self._store.generate_msgdef(name)
        return self._definitions[name]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)
