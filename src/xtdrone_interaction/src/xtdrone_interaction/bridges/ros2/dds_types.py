"""Types of ROS 2's messages for DDS: structures of cyclonedds, made from ROS 2's definitions, under ROS 2's names.

Sources: design.ros2.org, "Topic and Service name mapping to DDS" (``rt/`` before a topic's name) and the type names of
rosidl's generators (``std_msgs::msg::dds_::String_``).
"""

from __future__ import annotations

import functools
from typing import Any

import cyclonedds.idl.types as idl
from cyclonedds.idl import make_idl_struct
from rosbags.interfaces import Nodetype

from xtdrone_interaction.bridges.ros2.message_conversion import stores

_PLAIN = {
    "bool": bool,
    "byte": idl.uint8,
    "octet": idl.uint8,
    "char": idl.uint8,
    "int8": idl.int8,
    "uint8": idl.uint8,
    "int16": idl.int16,
    "uint16": idl.uint16,
    "int32": idl.int32,
    "uint32": idl.uint32,
    "int64": idl.int64,
    "uint64": idl.uint64,
    "float32": idl.float32,
    "float64": idl.float64,
    "string": str,
}


def dds_topic(topic: str) -> str:
    """Return the name in DDS of a ROS topic."""
    return f"rt/{topic.strip('/')}"


def ros_topic(name: str) -> str:
    """Return the ROS topic of a name in DDS, empty for names that are not topics of ROS 2."""
    return f"/{name.removeprefix('rt/')}" if name.startswith("rt/") else ""


def dds_type_name(name: str) -> str:
    """Return the type name in DDS of a type such as ``std_msgs/msg/String``."""
    package, kind, type_ = name.split("/")
    return f"{package}::{kind}::dds_::{type_}_"


def ros1_type(name: str) -> str:
    """Return the type in ROS 1 of a type name in DDS, empty if it is not a message type."""
    parts = name.split("::")
    if len(parts) != 4 or parts[1:3] != ["msg", "dds_"] or not parts[3].endswith("_"):
        return ""
    return f"{parts[0]}/{parts[3].removesuffix('_')}"


@functools.cache
def structure(name: str) -> type[Any]:
    """Return the structure of a message type such as ``std_msgs/msg/String``.

    Raises:
        KeyError: ROS 2 has no such standard type.
    """
    return _made(name)


def _made(name: str) -> type[Any]:
    _, ros2 = stores()
    _, fields = ros2.fielddefs[name]
    types = {field: _type(description) for field, description in fields}
    made: type[Any] = make_idl_struct(name.replace("/", "_"), dds_type_name(name), types)
    return made


def _type(description: Any) -> Any:
    kind, detail = description
    if kind == Nodetype.BASE:
        return _PLAIN[detail[0]]
    if kind == Nodetype.NAME:
        return structure(detail)
    element, size = _type(detail[0]), detail[1]
    array: Any = idl.array  # typed as classes that are not generic
    sequence: Any = idl.sequence
    return array[element, size] if kind == Nodetype.ARRAY else sequence[element]


@functools.cache
def carrier(name: str) -> type[Any]:
    """Return a structure whose samples carry their CDR unchanged: ``carrier(name)(cdr)``, and ``sample.cdr``.

    cyclonedds calls ``serialize`` and ``deserialize`` of a type, which these replace: the bytes come from
    ``message_conversion``, without a Python object for each field.
    """
    made = _made(name)

    def initialise(self: Any, cdr: bytes) -> None:
        self.cdr = cdr

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        return cls(bytes(data))

    made.__init__ = initialise  # type: ignore[misc]
    made.serialize = lambda self, *_, **__: self.cdr
    made.deserialize = classmethod(deserialize)
    return made
