"""Classes of message types that a program meets while it runs: the installed one, or one made from the definition.

A publisher sends its type's name, md5 sum and full definition with each connection. The installed class is used if its
md5 sum is the same; else genpy makes a class from the definition, so that types of foreign packages can be decoded too.
"""

from __future__ import annotations

import importlib
import re
import sys
import threading
from typing import Any

import genmsg
import genmsg.msgs
import genpy
import genpy.dynamic
import roslib.message

from xtdrone_lockstep.ros_codec import compile_class

TYPE_NAME = re.compile(r"[A-Za-z]\w*/[A-Za-z]\w*", re.ASCII)
"""Name of a message or service type."""
_LONGEST_DEFINITION = 1_000_000  # characters
_MOST_DYNAMIC = 200  # made classes that are kept; each is a module of its own

_lock = threading.Lock()
_made: dict[tuple[str, str], type[Any]] = {}


class MessageTypeError(ValueError):
    """A type that is not known, malformed or other than its publisher's."""


def installed_class(type_name: str) -> type[Any]:
    """Return the class of an installed type.

    Raises:
        MessageTypeError: it is not installed.
    """
    found = _installed(type_name)
    if found is None:
        raise MessageTypeError(f"type: {type_name!r} is not installed; build and source its package")
    return found


def message_class(type_name: str, md5sum: str = "*", definition: str = "") -> type[Any]:
    """Return the class that decodes a publisher's messages.

    Args:
        type_name: such as ``geometry_msgs/PoseStamped``.
        md5sum: of the definition; ``*`` for any.
        definition: full text, with the types it uses, as in a connection's header or a bag.

    Raises:
        MessageTypeError: the installed type is another one and there is no valid definition.
    """
    found = _installed(type_name)
    if found is not None and md5sum in ("*", found._md5sum):
        return found
    if not definition:
        there = f"md5 sum {found._md5sum} is installed" if found is not None else "it is not installed"
        raise MessageTypeError(f"type: {type_name} with md5 sum {md5sum} has no definition, and {there}")
    with _lock:
        if (type_name, md5sum) not in _made:
            _made[type_name, md5sum] = _make(type_name, md5sum, definition)
        return _made[type_name, md5sum]


def class_of_field(owner: type[Any], base: str) -> type[Any]:
    """Return the class of a field that is a message.

    Args:
        owner: class with the field.
        base: type of the field, without brackets.

    Raises:
        MessageTypeError: it is not known.
    """
    base = genmsg.msgs.resolve_type(base.partition("[")[0], owner._type.partition("/")[0])
    if owner.__module__ in sys.modules and not owner.__module__.startswith(owner._type.partition("/")[0] + "."):
        # genpy writes all classes of one definition into one module.
        made = getattr(sys.modules[owner.__module__], "_" + base.replace("/", "__"), None)
        if made is not None:
            return made
    return installed_class(base)


def decode(kind: type[Any], data: bytes) -> Any:
    """Return the message that bytes hold.

    Raises:
        MessageTypeError: they do not match the type.
    """
    try:
        return kind().deserialize(data)
    except Exception as error:  # struct, unicode and genpy's errors, by the place of the fault
        raise MessageTypeError(f"message: its {len(data)} bytes are no {kind._type}: {error}") from error


def _installed(type_name: str) -> type[Any] | None:
    if not isinstance(type_name, str) or not TYPE_NAME.fullmatch(type_name):
        raise MessageTypeError(f"type: {type_name!r} is not allowed, a name such as geometry_msgs/PoseStamped")
    try:
        found = roslib.message.get_message_class(type_name)
    except Exception:  # a package that fails on import: roslib lets its errors through
        return None
    if found is not None:
        compile_class(found)
    return found


def _make(type_name: str, md5sum: str, definition: str) -> type[Any]:
    if len(_made) >= _MOST_DYNAMIC:
        raise MessageTypeError(f"type: {type_name} is one more than the {_MOST_DYNAMIC} foreign types kept")
    if len(definition) > _LONGEST_DEFINITION:
        raise MessageTypeError(
            f"type: the definition of {type_name} has {len(definition)} characters, at most {_LONGEST_DEFINITION}"
        )
    try:
        importlib.invalidate_caches()  # genpy imports a file that it has just written
        made = genpy.dynamic.generate_dynamic(type_name, definition)[type_name]
    except Exception as error:  # the parser of definitions raises many kinds
        raise MessageTypeError(f"type: the definition of {type_name} is not valid: {error}") from error
    if md5sum not in ("*", made._md5sum):
        raise MessageTypeError(
            f"type: the definition of {type_name} has md5 sum {made._md5sum}, its publisher says {md5sum}"
        )
    return made
