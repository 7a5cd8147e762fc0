"""ULog file format: encoding of its messages, and a writer that enforces their order.

Source: docs.px4.io, "ULog File Format" (version 1 of the file, with flag bits). Little endian throughout. A file is a
header, then definitions (flag bits, info, formats, parameters), then data, which begins with the first subscription.
A message is its size (uint16, without these three bytes), its type (one character) and its payload.

The module uses neither the wall clock nor the autopilot, so that the same calls give the same bytes.
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
LARGEST_MESSAGE = 0xFFFF  # bytes of payload after the 3-byte message header
_MAX_KEY_SIZE = 0xFF
_MAX_ARRAY_LENGTH = 0xFFFF

SYSTEM_DEFAULT, SETUP_DEFAULT = 1, 2  # default of the firmware, default of the airframe

# ULog's basic types and their numpy equivalents
_TYPES = "int8_t uint8_t int16_t uint16_t int32_t uint32_t int64_t uint64_t float double bool char"
_NUMPY_TYPES = "<i1 <u1 <i2 <u2 <i4 <u4 <i8 <u8 <f4 <f8 ? <u1"
TYPES = dict(zip(_TYPES.split(), _NUMPY_TYPES.split(), strict=True))
_STRUCT_CODES = dict(zip(TYPES, "bBhHiIqQfd?", strict=False))

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MESSAGE_NAME = re.compile(r"[a-zA-Z0-9_/-]+")
_FIELD = re.compile(r"(?P<type>[A-Za-z_][A-Za-z0-9_]*)(?:\[(?P<length>[0-9]+)\])? (?P<name>[A-Za-z_][A-Za-z0-9_]*)")
_PADDING = "_padding"


class UlogError(ValueError):
    """Content that ULog cannot represent."""


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
        """Parse ``type name`` or ``type[length] name``.

        Raises:
            UlogError: ``text`` has another form or a length out of range.
        """
        match = _FIELD.fullmatch(text)
        if match is None:
            raise UlogError(f"field {text!r} is not allowed, 'type name' or 'type[length] name'")
        length = 0 if match["length"] is None else int(match["length"])
        if match["length"] is not None and not 1 <= length <= _MAX_ARRAY_LENGTH:
            raise UlogError(f"field {text!r}: length {length} is not allowed, 1 to {_MAX_ARRAY_LENGTH}")
        return cls(match["type"], length, match["name"])

    def __str__(self) -> str:
        return f"{self.type}[{self.length}] {self.name}" if self.length else f"{self.type} {self.name}"


@dataclass(frozen=True)
class Format:
    """Layout of a message: consecutive fields without gaps.

    Attributes:
        name: name of the message.
        fields: fields in order. Trailing fields whose name begins with ``_padding`` are declared but not written, a
            convention of PX4 that readers must follow.
        nested: formats used as types of fields.
    """

    name: str
    fields: tuple[Field, ...]
    nested: tuple[Format, ...] = ()

    def __post_init__(self) -> None:
        if not _MESSAGE_NAME.fullmatch(self.name):
            raise UlogError(f"format {self.name!r}: name is not allowed, only letters, digits, '_', '-' and '/'")
        names = [f.name for f in self.fields]
        doubled = next((name for name in names if names.count(name) > 1), None)
        if doubled is not None:
            raise UlogError(f"format {self.name}: field {doubled} is defined twice")
        known = {*TYPES, *(inner.name for inner in self.nested)}
        for f in self.fields:
            if f.type not in known:
                raise UlogError(f"format {self.name}: field {f.name}: unknown type {f.type!r}")
        if not self.dtype.itemsize:
            raise UlogError(f"format {self.name} has no fields besides padding")

    @classmethod
    def parse(cls, name: str, fields: str, nested: Sequence[Format] = ()) -> Format:
        """Parse fields in the form ``type name;type[length] name;...``.

        Raises:
            UlogError: invalid format; the text names the error.
        """
        return cls(name, tuple(Field.parse(text) for text in fields.rstrip(";").split(";")), tuple(nested))

    @cached_property
    def definition(self) -> str:
        """Text of the format message."""
        return f"{self.name}:" + "".join(f"{f};" for f in self.fields)

    @cached_property
    def dtype(self) -> np.dtype:
        """Packed numpy type of the written fields; ``char`` maps to uint8, a nested message to a nested type."""
        fields = list(self.fields)
        while fields and fields[-1].name.startswith(_PADDING):
            fields.pop()
        return self._dtype_of(fields)

    @cached_property
    def inner_dtype(self) -> np.dtype:
        """Packed numpy type of the message nested in another one, including its trailing padding."""
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
        """Whether the message can be logged, which requires a field ``uint64_t timestamp``."""
        return Field("uint64_t", 0, "timestamp") in self.fields


def _message(kind: bytes, payload: bytes, what: str) -> bytes:
    if len(payload) > LARGEST_MESSAGE:
        raise UlogError(f"{what}: {len(payload)} bytes are too many, at most {LARGEST_MESSAGE}")
    return struct.pack("<H", len(payload)) + kind + payload


def header(start_us: int) -> bytes:
    """Return the file header, 16 bytes; ``start_us`` is the start time of the log, microseconds."""
    return FILE_MAGIC + struct.pack("<Q", start_us)


def flag_bits() -> bytes:
    """Return the flag bits message: default parameters are used, no data are appended."""
    compatible = bytes([1, 0, 0, 0, 0, 0, 0, 0])
    return _message(b"B", compatible + bytes(8) + struct.pack("<3Q", 0, 0, 0), "flag bits")


def _key_value(kind: str, key: str, value: str | int | float | bytes, what: str) -> bytes:
    """Return the key-value payload of info and parameter messages.

    ``kind`` is one of the numeric ``TYPES``, or ``char`` to write text or bytes as ``char[length]``.
    """
    if not _NAME.fullmatch(key):
        raise UlogError(f"{what} {key!r}: name is not allowed, only letters, digits and '_'")
    if kind == "char":
        if not isinstance(value, (str, bytes)):
            raise UlogError(f"{what} {key}: {value!r} is not text")
        data = value.encode() if isinstance(value, str) else value
        kind = f"char[{len(data)}]"
    elif kind not in _STRUCT_CODES:
        raise UlogError(f"{what} {key}: type {kind!r} is not allowed, char or one of {', '.join(_STRUCT_CODES)}")
    else:
        try:
            data = struct.pack("<" + _STRUCT_CODES[kind], value)
        except (struct.error, OverflowError) as error:
            raise UlogError(f"{what} {key}: {value!r} is not a valid {kind}: {error}") from error
    name = f"{kind} {key}".encode()
    if len(name) > _MAX_KEY_SIZE:
        raise UlogError(f"{what} {key}: type and name have {len(name)} bytes, at most {_MAX_KEY_SIZE}")
    return bytes([len(name)]) + name + data


def info(kind: str, key: str, value: str | int | float) -> bytes:
    """Return an info message; ``kind`` is one of ``TYPES``, with ``char`` for text.

    Raises:
        UlogError: the value does not fit the type, or the key is invalid.
    """
    return _message(b"I", _key_value(kind, key, value, "info"), f"info {key}")


def multi_info(key: str, value: str, *, continued: bool = False) -> bytes:
    """Return one part of a multi-part info text; ``continued`` appends it to the preceding part.

    Raises:
        UlogError: the key is invalid, or the text is too long.
    """
    return _message(b"M", bytes([continued]) + _key_value("char", key, value, "multi info"), f"multi info {key}")


def parameter(name: str, value: int | float) -> bytes:
    """Return a parameter message; an int is written as int32_t, a float as float.

    Raises:
        UlogError: the value does not fit the type, or the name is invalid.
    """
    return _message(b"P", _parameter(name, value, "parameter"), f"parameter {name}")


def default_parameter(name: str, value: int | float, kinds: int) -> bytes:
    """Return a default parameter message; ``kinds`` is SYSTEM_DEFAULT, SETUP_DEFAULT or their sum.

    Raises:
        UlogError: the kind is unknown, the value does not fit the type, or the name is invalid.
    """
    if kinds not in (SYSTEM_DEFAULT, SETUP_DEFAULT, SYSTEM_DEFAULT | SETUP_DEFAULT):
        raise UlogError(f"default parameter {name}: kind {kinds} is not allowed, 1 (system), 2 (setup) or 3 (both)")
    return _message(b"Q", bytes([kinds]) + _parameter(name, value, "default parameter"), f"default parameter {name}")


def _parameter(name: str, value: int | float, what: str) -> bytes:
    return _key_value("int32_t" if isinstance(value, int) else "float", name, value, what)


def format_message(layout: Format) -> bytes:
    """Return the format message of ``layout``; its nested formats need messages of their own."""
    return _message(b"F", layout.definition.encode(), f"format {layout.name}")


def subscription(message_id: int, name: str, instance: int = 0) -> bytes:
    """Return the subscription message that binds ``message_id`` to a format.

    Args:
        message_id: 0 to 65535, unique in the file.
        name: name of the format.
        instance: instance of the topic, for example one of several sensors, 0 to 255.

    Raises:
        UlogError: a number is out of range.
    """
    if not 0 <= message_id <= 0xFFFF:
        raise UlogError(f"subscription of {name}: message id {message_id} is not allowed, 0 to 65535")
    if not 0 <= instance <= 0xFF:
        raise UlogError(f"subscription of {name}: instance {instance} is not allowed, 0 to 255")
    return _message(b"A", struct.pack("<BH", instance, message_id) + name.encode(), f"subscription of {name}")


def logged_string(level: int, time_us: int, text: str) -> bytes:
    """Return a logged string message; ``level`` is the syslog severity, 0 (emergency) to 7 (debug).

    Raises:
        UlogError: the level is out of range.
    """
    if not 0 <= level <= 7:
        raise UlogError(f"logged string {text!r}: level {level} is not allowed, 0 to 7")
    return _message(b"L", struct.pack("<BQ", ord("0") + level, time_us) + text.encode(), "logged string")


def sync() -> bytes:
    """Return a sync message, at which a reader of a damaged file can resume."""
    return _message(b"S", SYNC_MAGIC, "sync")


def dropout(milliseconds: int) -> bytes:
    """Return a dropout message with the duration of missing data, ms.

    Raises:
        UlogError: the duration is not 0 to 65535.
    """
    if not 0 <= milliseconds <= 0xFFFF:
        raise UlogError(f"dropout: {milliseconds} ms are not allowed, 0 to 65535")
    return _message(b"O", struct.pack("<H", milliseconds), "dropout")


def data_dtype(layout: Format) -> np.dtype:
    """Return the packed numpy type of a data message of ``layout``, byte for byte as in the file.

    Its fields are ``size``, ``kind``, ``id`` and ``record``; see ``data_template``.

    Raises:
        UlogError: the format has no timestamp, or exceeds the size of a message.
    """
    if not layout.has_timestamp:
        raise UlogError(f"format {layout.name} cannot be logged: it has no field 'uint64_t timestamp'")
    dtype = np.dtype([("size", "<u2"), ("kind", "u1"), ("id", "<u2"), ("record", layout.dtype)])
    if dtype.itemsize - 3 > LARGEST_MESSAGE:
        raise UlogError(f"format {layout.name}: {dtype.itemsize - 3} bytes are too many, at most {LARGEST_MESSAGE}")
    return dtype


def data_template(layout: Format, message_id: int) -> np.ndarray:
    """Return one data message of ``layout`` with a zeroed record, as an array of shape ().

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
        """Write ``data``."""

    def flush(self) -> object:
        """Flush buffered data."""


class UlogWriter:
    """Writer of one ULog that enforces the order of its sections.

    Messages are buffered, and ``flush`` writes complete messages to the sink. The file is a readable log after every
    flush.

    Attributes:
        written: bytes written to the sink so far.
    """

    def __init__(self, sink: _Sink, start_us: int) -> None:
        """Start the definitions section; ``start_us`` is the start time of the log, microseconds."""
        self._sink = sink
        self._parts: list[bytes | memoryview] = [header(start_us), flag_bits()]
        self._formats: dict[str, Format] = {}
        self._subscribed: dict[int, str] = {}
        self.written = 0

    @property
    def in_data(self) -> bool:
        """Whether the data section has begun."""
        return bool(self._subscribed)

    def add_info(self, kind: str, key: str, value: str | int | float) -> None:
        """Add an info message; see ``info``."""
        self._parts.append(info(kind, key, value))

    def add_multi_info(self, key: str, value: str, *, continued: bool = False) -> None:
        """Add one part of an info text; see ``multi_info``."""
        self._parts.append(multi_info(key, value, continued=continued))

    def add_parameter(self, name: str, value: int | float) -> None:
        """Add a parameter: its initial value in the definitions, its changed value in the data."""
        self._parts.append(parameter(name, value))

    def add_default_parameter(self, name: str, value: int | float, kinds: int) -> None:
        """Add a parameter's default; see ``default_parameter``."""
        self._parts.append(default_parameter(name, value, kinds))

    def add_format(self, layout: Format) -> None:
        """Define ``layout`` and its nested formats unless they are defined already.

        Raises:
            UlogError: another format has the same name, or the data section has begun.
        """
        known = self._formats.get(layout.name)
        if known == layout:
            return
        if known is not None:
            raise UlogError(f"format {layout.name} is already defined with other fields: {known.definition}")
        if self.in_data:
            raise UlogError(f"format {layout.name} is too late, the data section has begun")
        for inner in layout.nested:
            self.add_format(inner)
        self._formats[layout.name] = layout
        self._parts.append(format_message(layout))

    def subscribe(self, message_id: int, layout: Format, instance: int = 0) -> None:
        """Bind ``message_id`` to ``layout``; the first subscription begins the data section.

        Raises:
            UlogError: the format is not defined or cannot be logged, or the id is in use.
        """
        if self._formats.get(layout.name) != layout:
            raise UlogError(f"subscription of {layout.name}: its format is not defined")
        if message_id in self._subscribed:
            taken = self._subscribed[message_id]
            raise UlogError(f"subscription of {layout.name}: message id {message_id} is taken by {taken}")
        data_dtype(layout)
        self._parts.append(subscription(message_id, layout.name, instance))
        self._subscribed[message_id] = layout.name

    def add_messages(self, messages: bytes | memoryview) -> None:
        """Add complete messages: data (arrays of ``data_dtype``), logged strings, parameters."""
        self._parts.append(messages)

    def add_data(self, message_id: int, layout: Format, values: Mapping[str, object]) -> None:
        """Add one data message; fields missing from ``values`` are zero.

        Raises:
            UlogError: ``message_id`` is not subscribed to ``layout``, or a field is unknown.
        """
        if self._subscribed.get(message_id) != layout.name:
            raise UlogError(f"data of {layout.name}: message id {message_id} is not subscribed to it")
        template = data_template(layout, message_id)
        for name, value in values.items():
            if name not in (layout.dtype.names or ()):
                raise UlogError(f"data of {layout.name}: unknown field {name}")
            template["record"][name] = value
        self._parts.append(template.tobytes())

    def flush(self) -> None:
        """Write the buffered messages to the sink.

        Raises:
            OSError: the sink rejects the data.
        """
        if self._parts:
            data = b"".join(self._parts)
            self._parts.clear()
            self._sink.write(data)
            self._sink.flush()
            self.written += len(data)
