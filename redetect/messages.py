"""Quotes the content of untrusted files in messages: escaped, bounded, on one line.

Terminals interpret control characters, so those of a file must not reach it; and a file may contain
a word of a gigabyte. Every typed error of the project passes its message through `one_line`.
"""

from __future__ import annotations

import difflib
import os
import re
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

#: Environment variable that is set if only warnings and errors are to be shown.
QUIET = "REDETECT_QUIET"
#: Largest number of characters in a message; a path may be most of it.
LONGEST_MESSAGE = 1000
_LONGEST_EXCERPT = 60
_ELLIPSIS = " ... "

#: A command in backquotes, which keeps its flags, or a flag.
_FLAG = re.compile(r"(`[^`]*`)|(?<![\w/-])--([a-z][a-z-]*)")
#: Python does not format numbers of thousands of digits.
_MOST_BITS = 1000


class _ShortRepr(reprlib.Repr):
    def repr_int(self, x: int, level: int) -> str:
        long = x.bit_length() > _MOST_BITS
        return "a very long number" if long else super().repr_int(x, level)


_SHORT = _ShortRepr()
_SHORT.maxlevel = 3
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 40


def is_quiet() -> bool:
    """Whether only warnings and errors are to be shown."""
    return bool(os.environ.get(QUIET))


def one_line(text: str, longest: int = LONGEST_MESSAGE) -> str:
    """Make a text printable: control characters escaped, and at most `longest` characters kept."""
    if len(text) > longest:
        # Escapes make a text longer, never shorter: more than this is never shown.
        text = text[:longest] + _ELLIPSIS + text[-longest:]
    text = "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )
    if len(text) > longest:
        tail = (longest - len(_ELLIPSIS)) // 3
        text = text[: longest - len(_ELLIPSIS) - tail] + _ELLIPSIS + text[len(text) - tail :]
    return text


def excerpt(value: object) -> str:
    """Show a value from a file, however large and deep it is, in about 60 characters."""
    return one_line(_SHORT.repr(value), _LONGEST_EXCERPT)


def counted(number: int, noun: str) -> str:
    """A number with its noun: `1 disc`, `2 discs`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def no_such(what: str, word: str, known: Iterable[str]) -> str:
    """The message for an unknown word, with the nearest known one."""
    near = difflib.get_close_matches(word.lower(), sorted(known), 1, 0.5)
    names = ", ".join(sorted(known))
    return f"{what} {excerpt(word)}: " + (f"did you mean {near[0]}?" if near else f"one of {names}")


class OneLineError(Exception):
    """An error whose message is one printable line of bounded length (`one_line`)."""

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message))


@contextmanager
def imported_for(
    use: str, extra: str, error: type[Exception], otherwise: str = ""
) -> Iterator[None]:
    """Import a package of an extra in a block; if missing, the error states how to install it."""
    try:
        yield
    except ImportError:
        raise error(f"{use}: install it by pip install 'redetect[{extra}]'{otherwise}") from None


def path_of(value: Any, expected: str, error: type[Exception]) -> Path:
    """A path; an error with what was expected if the value is none."""
    if not isinstance(value, str | os.PathLike):
        raise error(f"{excerpt(value)}: expected {expected}")
    return Path(value)


@contextmanager
def keywords_named() -> Iterator[None]:
    """Errors of a function that name flags, `--image-topic`, name its keywords, `image_topic`."""
    try:
        yield
    except OneLineError as error:
        error.args = (_FLAG.sub(_keyword, str(error)),)
        raise


def _keyword(found: re.Match[str]) -> str:
    return found[1] or f"`{found[2].replace('-', '_')}`"
