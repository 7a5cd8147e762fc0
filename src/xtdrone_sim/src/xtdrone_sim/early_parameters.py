"""Private parameters that a node needs before it is registered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import rosgraph
import yaml

from xtdrone_control import lockstep


def private_parameters(name: str, arguments: Sequence[str]) -> dict[str, Any]:
    """Return the private parameters before the node is registered: the rate of its turns depends on them.

    Args:
        name: of the node, unless the command line gives another.
        arguments: the command line, with ``_rate:=2`` and the like.
    """
    name = lockstep.future_name(name)
    found = rosgraph.Master(name).getParam("/")
    for part in name.strip("/").split("/"):
        found = found.get(part, {}) if isinstance(found, Mapping) else {}
    values = dict(found) if isinstance(found, Mapping) else {}
    for argument in arguments:
        key, mapped, text = argument.partition(":=")
        if mapped and key.startswith("_") and not key.startswith("__"):
            values[key[1:]] = yaml.safe_load(text)
    return values
