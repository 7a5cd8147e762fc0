"""The ULog file format: its messages as bytes, and a writer that keeps them in order.

Source: docs.px4.io, "ULog File Format" (version 1 of the file, with flag bits). Little endian throughout. A file is a
header, then definitions (flag bits, info, formats, parameters), then data, which begins with the first subscription.
A message is its size (uint16, without these three bytes), its type (one character) and its payload.

Nothing here knows the time of day or the autopilot: the same calls give the same bytes.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

FILE_MAGIC = b"ULog\x01\x12\x35\x01"
SYNC_MAGIC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
HEADER_SIZE = 16
LARGEST_MESSAGE = 0xFFFF  # bytes after the three of the message's header
_LARGEST_KEY = 0xFF
_LARGEST_ARRAY = 0xFFFF

SYSTEM_DEFAULT, SETUP_DEFAULT = 1, 2  # what a default parameter is a default of: the firmware, the airframe

# ULog's name of a basic type to numpy's
TYPES: dict[str, str] = {
    "int8_t": "<i1",
    "uint8_t": "<u1",
    "int16_t": "<i2",
    "uint16_t": "<u2",
    "int32_t": "<i4",
    "uint32_t": "<u4",
    "int64_t": "<i8",
    "uint64_t": "<u8",
    "float": "<f4",
    "double": "<f8",
    "bool": "?",
    "char": "<u1",
}
_STRUCT_CODES = dict(zip(TYPES, "bBhHiIqQfd?", strict=False))

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MESSAGE_NAME = re.compile(r"[a-zA-Z0-9_/-]+")
_FIELD = re.compile(r"(?P<type>[A-Za-z_][A-Za-z0-9_]*)(?:\[(?P<length>[0-9]+)\])? (?P<name>[A-Za-z_][A-Za-z0-9_]*)")
_PADDING = "_padding"


class UlogError(ValueError):
    """Something that cannot be written as ULog."""


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        type: a name in ``TYPES``, or another format's.
        length: number of elements of an array, 0 for a single value.
        name: the field's name.
    """

    type: str
    length: int
    name: str

    @classmethod
    def parse(cls, text: str) -> Field:
        """Read ``type name`` or ``type[length] name``.

        Raises:
            UlogError: ``text`` is neither.
        """
        match = _FIELD.fullmatch(text)
        if match is None:
            raise UlogError(f"field {text!r} is not allowed, 'type name' or 'type[length] name'")
        length = 0 if match["length"] is None else int(match["length"])
        if match["length"] is not None and not 1 <= length <= _LARGEST_ARRAY:
            raise UlogError(f"field {text!r}: length {length} is not allowed, 1 to {_LARGEST_ARRAY}")
        return cls(match["type"], length, match["name"])

    def __str__(self) -> str:
        return f"{self.type}[{self.length}] {self.name}" if self.length else f"{self.type} {self.name}"


@dataclass(frozen=True)
class Format:
    """The layout of a message: fields one after the other, without gaps.

    Attributes:
        name: the message's name.
        fields: its fields. Those at the end whose name begins with ``_padding`` are announced but not written, as PX4
            does; a reader must know.
        nested: the formats that fields are made of.
    """

    name: str
    fields: tuple[Field, ...]
    nested: tuple[Format, ...] = ()

    def __post_init__(self) -> None:
        if not _MESSAGE_NAME.fullmatch(self.name):
            raise UlogError(f"format {self.name!r}: the name may have letters, digits, '_', '-' and '/' only")
        names = [f.name for f in self.fields]
        doubled = next((name for name in names if names.count(name) > 1), None)
        if doubled is not None:
            raise UlogError(f"format {self.name}: field {doubled} is there twice")
        known = {*TYPES, *(inner.name for inner in self.nested)}
        for f in self.fields:
            if f.type not in known:
                raise UlogError(f"format {self.name}: field {f.name}: type {f.type!r} is not known")
        if not self.dtype.itemsize:
            raise UlogError(f"format {self.name} has no field that is written")

    @classmethod
    def parse(cls, name: str, fields: str, nested: Sequence[Format] = ()) -> Format:
        """Make a format of ``type name;type[length] name;...``.

        Raises:
            UlogError: it is no valid format; the message names what is wrong.
        """
        return cls(name, tuple(Field.parse(text) for text in fields.rstrip(";").split(";")), tuple(nested))

    @cached_property
    def definition(self) -> str:
        """The text of the format message."""
        return f"{self.name}:" + "".join(f"{f};" for f in self.fields)

    @cached_property
    def dtype(self) -> np.dtype:
        """The packed numpy type of what is written; ``char`` is a uint8, a nested message a nested type."""
        fields = list(self.fields)
        while fields and fields[-1].name.startswith(_PADDING):
            fields.pop()
        return self._dtype_of(fields)

    @cached_property
    def inner_dtype(self) -> np.dtype:
        """The packed numpy type of this message inside another one: with the padding at its end."""
        return self._dtype_of(self.fields)

    def _dtype_of(self, fields: Sequence[Field]) -> np.dtype:
        inner = {f.name: f for f in self.nested}
        parts: list[tuple] = []
        for f in fields:
            kind = np.dtype(TYPES[f.type]) if f.type in TYPES else inner[f.type].inner_dtype
            parts.append((f.name, kind, (f.length,)) if f.length else (f.name, kind))
        return np.dtype(parts)

    @cached_property
    def has_timestamp(self) -> bool:
        """Whether it can be logged: one of its fields is ``uint64_t timestamp``."""
        return Field("uint64_t", 0, "timestamp") in self.fields


def _message(kind: bytes, payload: bytes, what: str) -> bytes:
    if len(payload) > LARGEST_MESSAGE:
        raise UlogError(f"{what}: {len(payload)} bytes are too many, at most {LARGEST_MESSAGE}")
    return struct.pack("<H", len(payload)) + kind + payload


def header(start_us: int) -> bytes:
    """Return the file's first 16 bytes; ``start_us`` is the time at which logging began, microseconds."""
    return FILE_MAGIC + struct.pack("<Q", start_us)


def flag_bits() -> bytes:
    """Return the flag bits: default parameters may come, nothing else is special; no appended data."""
    compatible = bytes([1, 0, 0, 0, 0, 0, 0, 0])
    return _message(b"B", compatible + bytes(8) + struct.pack("<3Q", 0, 0, 0), "flag bits")


def _key_value(kind: str, key: str, value: str | int | float | bytes, what: str) -> bytes:
    """Return a value with its type and name, as info and parameter messages have it.

    ``kind`` is one of the numeric ``TYPES``; ``char`` writes a text or bytes as ``char[length]``.
    """
    if not _NAME.fullmatch(key):
        raise UlogError(f"{what} {key!r}: the name may have letters, digits and '_' only")
    if kind == "char":
        if not isinstance(value, (str, bytes)):
            raise UlogError(f"{what} {key}: {value!r} is no text")
        data = value.encode() if isinstance(value, str) else value
        kind = f"char[{len(data)}]"
    elif kind not in _STRUCT_CODES:
        raise UlogError(f"{what} {key}: type {kind!r} is not allowed, char or one of {', '.join(_STRUCT_CODES)}")
    else:
        try:
            data = struct.pack("<" + _STRUCT_CODES[kind], value)
        except (struct.error, OverflowError) as error:
            raise UlogError(f"{what} {key}: {value!r} is no {kind}: {error}") from error
    name = f"{kind} {key}".encode()
    if len(name) > _LARGEST_KEY:
        raise UlogError(f"{what} {key}: type and name have {len(name)} bytes, at most {_LARGEST_KEY}")
    return bytes([len(name)]) + name + data


def info(kind: str, key: str, value: str | int | float) -> bytes:
    """Return an info message: ``kind`` is one of ``TYPES``, where ``char`` takes a text.

    Raises:
        UlogError: a value that the type cannot hold, or a bad name.
    """
    return _message(b"I", _key_value(kind, key, value, "info"), f"info {key}")


def multi_info(key: str, value: str, *, continued: bool = False) -> bytes:
    """Return one piece of an info text that comes in several; ``continued``: it goes on with the piece before.

    Raises:
        UlogError: a bad name, or too long a text.
    """
    return _message(b"M", bytes([continued]) + _key_value("char", key, value, "multi info"), f"multi info {key}")


def parameter(name: str, value: int | float) -> bytes:
    """Return a parameter's value: an int is written as int32_t, a float as float.

    Raises:
        UlogError: a value that the type cannot hold, or a bad name.
    """
    return _message(b"P", _parameter(name, value, "parameter"), f"parameter {name}")


def default_parameter(name: str, value: int | float, kinds: int) -> bytes:
    """Return a parameter's default; ``kinds`` is SYSTEM_DEFAULT, SETUP_DEFAULT, or both of them added.

    Raises:
        UlogError: another kind, a value that the type cannot hold, or a bad name.
    """
    if kinds not in (SYSTEM_DEFAULT, SETUP_DEFAULT, SYSTEM_DEFAULT | SETUP_DEFAULT):
        raise UlogError(f"default parameter {name}: kind {kinds} is not allowed, 1 (system), 2 (setup) or 3 (both)")
    return _message(b"Q", bytes([kinds]) + _parameter(name, value, "default parameter"), f"default parameter {name}")


def _parameter(name: str, value: int | float, what: str) -> bytes:
    return _key_value("int32_t" if isinstance(value, int) else "float", name, value, what)


def format_message(layout: Format) -> bytes:
    """Return the message that announces ``layout``; those nested in it must be announced, too."""
    return _message(b"F", layout.definition.encode(), f"format {layout.name}")


def subscription(message_id: int, name: str, instance: int = 0) -> bytes:
    """Return the message that says which message ``message_id`` stands for.

    Args:
        message_id: 0 to 65535, new in the file.
        name: the format's name.
        instance: number of the sensor or the like, 0 to 255.

    Raises:
        UlogError: a number out of range.
    """
    if not 0 <= message_id <= 0xFFFF:
        raise UlogError(f"subscription of {name}: message id {message_id} is not allowed, 0 to 65535")
    if not 0 <= instance <= 0xFF:
        raise UlogError(f"subscription of {name}: instance {instance} is not allowed, 0 to 255")
    return _message(b"A", struct.pack("<BH", instance, message_id) + name.encode(), f"subscription of {name}")


def logged_string(level: int, time_us: int, text: str) -> bytes:
    """Return a text with its severity (``level``: syslog's, 0 emergency to 7 debug) and time in microseconds.

    Raises:
        UlogError: another level.
    """
    if not 0 <= level <= 7:
        raise UlogError(f"logged string {text!r}: level {level} is not allowed, 0 to 7")
    return _message(b"L", struct.pack("<BQ", ord("0") + level, time_us) + text.encode(), "logged string")


def sync() -> bytes:
    """Return a message by which a reader finds its place again in a damaged file."""
    return _message(b"S", SYNC_MAGIC, "sync")


def dropout(milliseconds: int) -> bytes:
    """Return a message that says for how long data could not be written.

    Raises:
        UlogError: not 0 to 65535.
    """
    if not 0 <= milliseconds <= 0xFFFF:
        raise UlogError(f"dropout: {milliseconds} ms are not allowed, 0 to 65535")
    return _message(b"O", struct.pack("<H", milliseconds), "dropout")


def data_dtype(layout: Format) -> np.dtype:
    """Return the packed numpy type of a whole data message of ``layout``: an array of it is what the file has.

    Its fields: ``size``, ``kind``, ``id`` and ``record``; see ``data_template``.

    Raises:
        UlogError: it has no timestamp, or is too large for a message.
    """
    if not layout.has_timestamp:
        raise UlogError(f"format {layout.name} cannot be logged: it has no field 'uint64_t timestamp'")
    dtype = np.dtype([("size", "<u2"), ("kind", "u1"), ("id", "<u2"), ("record", layout.dtype)])
    if dtype.itemsize - 3 > LARGEST_MESSAGE:
        raise UlogError(f"format {layout.name}: {dtype.itemsize - 3} bytes are too many, at most {LARGEST_MESSAGE}")
    return dtype


def data_template(layout: Format, message_id: int) -> np.ndarray:
    """Return one data message of ``layout`` as an array of shape (), its record all zeros.

    Raises:
        UlogError: see ``data_dtype``.
    """
    template = np.zeros((), data_dtype(layout))
    template["size"] = template.dtype.itemsize - 3
    template["kind"] = ord("D")
    template["id"] = message_id
    return template


class _Sink(Protocol):
    def write(self, data: bytes, /) -> object:
        """Take ``data``."""

    def flush(self) -> object:
        """Pass on all that was taken."""


class UlogWriter:
    """Writes one ULog, and sees to the order of its parts.

    Messages are collected and handed to the sink by ``flush``, whole. What has been handed over is a readable log,
    whatever happens next.

    Attributes:
        written: bytes handed over so far.
    """

    def __init__(self, sink: _Sink, start_us: int) -> None:
        """Begin the definitions; ``start_us`` is the time at which logging begins, microseconds."""
        self._sink = sink
        self._parts: list[bytes | memoryview] = [header(start_us), flag_bits()]
        self._formats: dict[str, Format] = {}
        self._subscribed: dict[int, str] = {}
        self.written = 0

    @property
    def in_data(self) -> bool:
        """Whether the definitions are over."""
        return bool(self._subscribed)

    def add_info(self, kind: str, key: str, value: str | int | float) -> None:
        """Add an info message; see ``info``."""
        self._parts.append(info(kind, key, value))

    def add_multi_info(self, key: str, value: str, *, continued: bool = False) -> None:
        """Add one piece of an info text; see ``multi_info``."""
        self._parts.append(multi_info(key, value, continued=continued))

    def add_parameter(self, name: str, value: int | float) -> None:
        """Add a parameter: its value at the start, or in the data its new one."""
        self._parts.append(parameter(name, value))

    def add_default_parameter(self, name: str, value: int | float, kinds: int) -> None:
        """Add a parameter's default; see ``default_parameter``."""
        self._parts.append(default_parameter(name, value, kinds))

    def add_format(self, layout: Format) -> None:
        """Announce ``layout`` and what is nested in it, what is not announced yet.

        Raises:
            UlogError: another layout has that name, or the data have begun.
        """
        known = self._formats.get(layout.name)
        if known == layout:
            return
        if known is not None:
            raise UlogError(f"format {layout.name} is announced already, with other fields: {known.definition}")
        if self.in_data:
            raise UlogError(f"format {layout.name} comes too late: the data have begun")
        for inner in layout.nested:
            self.add_format(inner)
        self._formats[layout.name] = layout
        self._parts.append(format_message(layout))

    def subscribe(self, message_id: int, layout: Format, instance: int = 0) -> None:
        """Let ``message_id`` stand for ``layout``; the first one ends the definitions.

        Raises:
            UlogError: the format is not announced, cannot be logged, or the number is taken.
        """
        if self._formats.get(layout.name) != layout:
            raise UlogError(f"subscription of {layout.name}: its format is not announced")
        if message_id in self._subscribed:
            taken = self._subscribed[message_id]
            raise UlogError(f"subscription of {layout.name}: message id {message_id} is taken by {taken}")
        data_dtype(layout)
        self._parts.append(subscription(message_id, layout.name, instance))
        self._subscribed[message_id] = layout.name

    def add_messages(self, messages: bytes | memoryview) -> None:
        """Add whole messages: data (arrays of ``data_dtype``), logged strings, parameters."""
        self._parts.append(messages)

    def add_data(self, message_id: int, layout: Format, values: Mapping[str, object]) -> None:
        """Add one data message; a field that ``values`` does not name is zero.

        Raises:
            UlogError: nobody has subscribed the number to the layout, or a field is unknown.
        """
        if self._subscribed.get(message_id) != layout.name:
            raise UlogError(f"data of {layout.name}: message id {message_id} is not subscribed to it")
        template = data_template(layout, message_id)
        for name, value in values.items():
            if name not in (layout.dtype.names or ()):
                raise UlogError(f"data of {layout.name}: it has no field {name}")
            template["record"][name] = value
        self._parts.append(template.tobytes())

    def flush(self) -> None:
        """Hand over what has been collected.

        Raises:
            OSError: the sink cannot take it.
        """
        if self._parts:
            data = b"".join(self._parts)
            self._parts.clear()
            self._sink.write(data)
            self._sink.flush()
            self.written += len(data)
