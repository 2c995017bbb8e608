"""What the node needs of ROS, where there is none: messages as strict as ROS's own, and `rclpy`.

Messages have the fields that the standard type store of `rosbags` says. As those of `rclpy`, they
are made from keywords, what is not given is zero or empty, and a value of another type is refused.
"""

from __future__ import annotations

import array
import sys
from collections.abc import Callable, Mapping
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

_FIELDS = get_typestore(Stores.ROS2_HUMBLE).fielddefs
_NUMBERS = {"bool": bool, "string": str, "float32": float, "float64": float}


class Message:
    """A message of any type."""

    kind: str

    def __init__(self, **given: Any) -> None:
        fields = dict(_FIELDS[self.kind][1])
        assert given.keys() <= fields.keys(), f"{self.kind}: {given.keys() - fields.keys()}"
        for name, description in fields.items():
            value = given.get(name, _empty(*description))
            assert _fits(value, *description), f"{self.kind}.{name}: {value!r}"
            setattr(self, name, value)


@cache
def get_message(kind: str) -> type[Message]:
    """The class of a type, as `rosidl_runtime_py.utilities` gives it."""
    return type(kind, (Message,), {"kind": kind})


def _empty(node: int, of: Any) -> Any:
    if node == Nodetype.NAME:
        return get_message(of)()
    if node == Nodetype.ARRAY:
        return np.zeros(of[1])
    return [] if node == Nodetype.SEQUENCE else _NUMBERS.get(of[0], int)()


def _fits(value: Any, node: int, of: Any) -> bool:
    if node == Nodetype.NAME:
        return isinstance(value, get_message(of))
    if node == Nodetype.ARRAY:
        return isinstance(value, np.ndarray) and value.dtype == np.float64 and len(value) == of[1]
    if node == Nodetype.BASE:
        return type(value) is _NUMBERS.get(of[0], int) or (
            isinstance(value, float) and of[0] in ("float32", "float64")
        )
    if isinstance(value, array.array):
        return value.typecode == "B" and of[0] == (Nodetype.BASE, ("uint8", 0))
    return isinstance(value, list) and all(_fits(element, *of[0]) for element in value)


class Node:
    """A node with the parameters and remappings of `Ros`, which keeps what is published."""

    ros: Ros

    def __init__(self, name: str) -> None:
        self.ros.node = self
        self.name = name
        self.subscribed: dict[str, tuple[type[Message], Callable[[Any], None]]] = {}
        self.warnings: list[str] = []

    def declare_parameter(self, name: str, default: object) -> SimpleNamespace:
        value = self.ros.parameters.get(name, default)
        assert type(value) is type(default), name
        return SimpleNamespace(value=value)

    def resolve_topic_name(self, name: str) -> str:
        return self.ros.remapped.get(name, f"/{name}")

    def create_publisher(self, kind: type[Message], topic: str, qos: Any) -> SimpleNamespace:
        name = topic.replace("~", f"/{self.name}")

        def publish(message: Message) -> None:
            assert type(message) is kind
            self.ros.published.append((name, message, qos))

        return SimpleNamespace(publish=publish)

    def create_subscription(
        self, kind: type[Message], topic: str, callback: Callable[[Any], None], qos: Any
    ) -> None:
        self.subscribed[topic] = kind, callback

    def get_logger(self) -> SimpleNamespace:
        def warning(text: str, *, throttle_duration_sec: float) -> None:
            self.warnings.append(text)

        return SimpleNamespace(warning=warning)


class Ros:
    """ROS, beside one node: its parameters and remapped topics, and what it has published."""

    def __init__(self, parameters: Mapping[str, object], remapped: Mapping[str, str]) -> None:
        self.parameters, self.remapped = parameters, remapped
        self.published: list[tuple[str, Any, Any]] = []
        self.node: Node | None = None
        self.events: list[str] = []

    def send(self, topic: str, **fields: Any) -> None:
        """Give the node a message of a topic to which it has subscribed."""
        assert self.node is not None
        kind, callback = self.node.subscribed[topic]
        callback(kind(**fields))

    def of_topic(self, topic: str) -> list[Any]:
        """The messages of a topic."""
        return [message for name, message, _ in self.published if name == topic]

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Put the modules that the node imports in the place of ROS's own."""
        policies = {
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort"),
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="transient local"),
        }
        contents: dict[str, dict[str, object]] = {
            "rclpy": {
                "init": lambda args: self.events.append("init"),
                "spin": lambda node: self.events.append("spin"),
                "try_shutdown": lambda: self.events.append("shutdown"),
            },
            "rclpy.executors": {"ExternalShutdownException": type("Ended", (Exception,), {})},
            "rclpy.node": {"Node": type("Node", (Node,), {"ros": self})},
            "rclpy.qos": {"QoSProfile": SimpleNamespace, **policies},
            "rosidl_runtime_py": {},
            "rosidl_runtime_py.utilities": {"get_message": get_message},
        }
        for name, content in contents.items():
            module = ModuleType(name)
            vars(module).update(content)
            monkeypatch.setitem(sys.modules, name, module)
