"""Notices of an operator's action for the other pages, so that operators of one vehicle learn of each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_SILENT = frozenset({"steering.send"})  # ten a second; pages that steer the same vehicle are told by their own event
_MOST_NAMES = 4
_LONGEST = 120  # characters


def in_words(method: str, params: Mapping[str, Any]) -> str:
    """Return the notice of an action, as ``takeoff: iris_0, iris_1``; empty for one of which the other pages get none.

    Args:
        method: name, as ``vehicles.command``.
        params: as the page has sent them; they may be of any kind.
    """
    if method in _SILENT:
        return ""
    what = next((str(params[key]) for key in ("action", "text") if params.get(key)), method.replace(".", " "))
    if what == "speed":
        what = f"speed {params.get('factor')}"
    whom = _names(params)
    return f"{what}: {whom}"[:_LONGEST] if whom else what[:_LONGEST]


def _names(params: Mapping[str, Any]) -> str:
    for key in ("vehicles", "files"):
        named = params.get(key)
        if isinstance(named, (list, dict)) and named:
            names = [str(name) for name in named]
            more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
            return f"{', '.join(names[:_MOST_NAMES])}{more}"
    return next((str(params[key]) for key in ("target", "vehicle", "topic", "name") if params.get(key)), "")
