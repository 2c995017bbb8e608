"""The messages of a bag, read by the package ``rosbags``; errors are reported on one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from detect.errors import DetectError
from storage.messages import OneLineError, one_line

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

#: Characters that are shown of what another package says, and of topics and types in a bag.
_LONGEST_CAUSE, LONGEST_NAME = 200, 60


@contextmanager
def opened_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag.

    Raises
    ------
    DetectError
        If the package is not installed, or the bag cannot be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DetectError(
            f"{path}: bags are read by the package rosbags: install it by "
            "pip install 'redetect[bags]'"
        ) from None
    # Bags of older ROS 2 do not contain the definitions of their messages.
    defaults = get_typestore(Stores.LATEST)
    try:
        reader = AnyReader([path], default_typestore=defaults)
        reader.open()
    except Exception as error:  # a damaged file can raise anything
        raise DetectError(
            f"{path}: cannot be read as a bag: {_one_line(error)}: expected a whole ROS 1 or 2 bag "
            "or an MCAP file of ROS messages"
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def messages(reader: AnyReader, path: Path, topic: str) -> Iterator[tuple[str, float, Any]]:
    """The messages of a topic: type, time of recording (s), and content.

    Raises
    ------
    DetectError
        If the bag is damaged.
    """
    connections = [c for c in reader.connections if c.topic == topic]
    stream = reader.messages(connections)
    number = 0
    while True:
        try:
            connection, recorded_ns, content = next(stream)
            recorded_s = recorded_ns / 1e9  # a database's column may hold anything
            message = reader.deserialize(content, connection.msgtype)
        except StopIteration:
            return
        except Exception as error:  # as above
            raise DetectError(
                f"{path}: message {number + 1} of {one_line(topic, LONGEST_NAME)} cannot be read: "
                f"{_one_line(error)}: "
                f"expected a whole bag (--frames takes the first images only)"
            ) from None
        number += 1
        yield connection.msgtype, recorded_s, message


@contextmanager
def understood(name: str) -> Iterator[None]:
    """Work on a message: a bag brings its own definitions, which may be other than ROS's.

    Raises
    ------
    DetectError
        If the message lacks what ROS's has, or has something else there.
    """
    try:
        yield
    except OneLineError:  # that has been said already
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise DetectError(
            f"{name}: a message is not as ROS defines it: {_one_line(error)}"
        ) from None


def chosen_topic(
    reader: AnyReader,
    path: Path,
    kinds: tuple[str, ...],
    named: str | None,
    what: str,
    flag: str,
) -> str:
    """The topic that was named, or the only one of some types.

    Raises
    ------
    DetectError
        If there is no such topic, or there are several and none was named.
    """
    topics = sorted({c.topic for c in reader.connections if c.msgtype in kinds})
    listed = ", ".join(one_line(topic, LONGEST_NAME) for topic in topics[:6]) or "none"
    expected = " or ".join(kind.replace("/msg", "") for kind in kinds)
    if named is not None:
        if named in topics:
            return named
        raise DetectError(f"{path}: no {what} in {named!r}: expected {expected}, of {listed}")
    if not topics:
        there = sorted({str(c.msgtype) for c in reader.connections})[:6]
        held = ", ".join(one_line(kind, LONGEST_NAME) for kind in there) or "no messages"
        raise DetectError(f"{path}: no {what} in it, but {held}: expected {expected}")
    if len(topics) > 1:
        raise DetectError(f"{path}: several topics of {what} ({listed}): name one by {flag}")
    return topics[0]


def stamp_s(message: Any, recorded_s: float) -> float:
    """The time in a message's header (s); that of its recording where the header has none."""
    stamp = message.header.stamp
    return (stamp.sec + stamp.nanosec / 1e9) if stamp.sec or stamp.nanosec else recorded_s


def _one_line(error: Exception) -> str:
    return one_line(" ".join(str(error).split()) or type(error).__name__, _LONGEST_CAUSE)
