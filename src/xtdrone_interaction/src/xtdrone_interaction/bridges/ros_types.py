"""Service types by their names, for the bridges; message types are in ``topics.message_classes``."""

from __future__ import annotations

import functools
from typing import Any

import roslib.message

from xtdrone_interaction.topics.message_classes import TYPE_NAME


class ServiceTypeError(ValueError):
    """A service type that is malformed or unknown."""


@functools.lru_cache(maxsize=1024)
def service_class(type_: str) -> Any:
    """Return the generated class of a service type such as ``std_srvs/Trigger``.

    Raises:
        ServiceTypeError: malformed or unknown.
    """
    if not TYPE_NAME.fullmatch(type_):
        raise ServiceTypeError(f"type: {type_!r} is not allowed, a name such as std_srvs/Trigger")
    try:
        found = roslib.message.get_service_class(type_)
    except Exception:  # a package that fails on import: roslib lets its errors through
        found = None
    if found is None:
        raise ServiceTypeError(f"type: {type_!r} is not installed; build and source its package")
    return found
