"""Settings of one vehicle's plugins, by MAVROS's parameter names, and the selection of plugins.

MAVROS 1.x calls the lists of shell patterns ``plugin_blacklist`` and ``plugin_whitelist``, MAVROS 2.x
``plugin_denylist`` and ``plugin_allowlist``; both names are equivalent. The rules are those of MAVROS's ``mavros.cpp``:
a plugin is skipped if a denied pattern matches its name and no allowed one does; with only allowed patterns, all others
are denied. Matching ignores case.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

T = TypeVar("T", bool, int, float, str, list[Any], dict[str, Any])


class ParamError(ValueError):
    """A parameter has a value of the wrong type."""


class Params:
    """Parameter lookup in several trees; the first tree with the name wins.

    The trees are the vehicle's (``/iris_0/mavros/...``, as in real MAVROS) and the node's, which applies to all
    vehicles.
    """

    def __init__(self, *trees: Mapping[str, Any]) -> None:
        """Store nested dictionaries as returned by rospy.get_param, the most specific first."""
        self._trees = trees

    def get(self, name: str, default: T) -> T:
        """Return parameter ``name`` (e.g. ``local_position/tf/send``), or ``default``.

        Raises:
            ParamError: the value does not have the default's type (an int is accepted for a float).
        """
        return _check_type(name, self.get_any(name, default), default)

    def get_any(self, name: str, default: Any) -> Any:
        """Return parameter ``name`` of any type, or ``default``."""
        for tree in self._trees:
            value = _find(tree, name)
            if value is not None:
                return value
        return default


def _find(tree: Mapping[str, Any], name: str) -> Any:
    node: Any = tree
    for part in name.split("/"):
        if not isinstance(node, Mapping) or part not in node:
            return None
        node = node[part]
    return node


def _check_type(name: str, value: Any, default: T) -> T:
    kind = type(default)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise ParamError(f"parameter {name}: {value!r} is not of type {kind.__name__}")
    return value


_DENY = ("plugin_denylist", "plugin_blacklist")
_ALLOW = ("plugin_allowlist", "plugin_whitelist")


class PluginLists:
    """Denied and allowed plugins of one vehicle."""

    def __init__(self, params: Params) -> None:
        """Read the lists.

        Raises:
            ParamError: a value is not a list of strings.
        """
        self._deny = {name: _patterns(params, name) for name in _DENY}
        self._allow = {name: _patterns(params, name) for name in _ALLOW}

    def loads(self, name: str) -> bool:
        """Return whether the plugin ``name`` is loaded."""
        allowed = [pattern for patterns in self._allow.values() for pattern in patterns]
        denied = [pattern for patterns in self._deny.values() for pattern in patterns]
        if not denied:
            return not allowed or _matches(name, allowed)
        return not _matches(name, denied) or _matches(name, allowed)

    def complaints(self, here: Iterable[str], left_out: Mapping[str, str]) -> Iterator[str]:
        """Yield a sentence for each pattern that has no effect.

        Args:
            here: names of the plugins of this layer.
            left_out: MAVROS plugins that this layer lacks, with the reason. Denying one of them is not a mistake.
        """
        here = list(here)
        for name, patterns in (self._deny | self._allow).items():
            for pattern in patterns:
                if any(_matches(plugin, [pattern]) for plugin in here):
                    continue
                known = [plugin for plugin in left_out if _matches(plugin, [pattern])]
                if not known:
                    yield f"{name}: no plugin matches {pattern!r}"
                elif name in _ALLOW:
                    reasons = "; ".join(f"{plugin}: {left_out[plugin]}" for plugin in known)
                    yield f"{name}: {pattern!r} is not offered here ({reasons})"


def _patterns(params: Params, name: str) -> list[str]:
    empty: list[Any] = []
    patterns = params.get(name, empty)
    for pattern in patterns:
        if not isinstance(pattern, str):
            raise ParamError(f"parameter {name}: {pattern!r} is not a pattern of plugin names, such as 'setpoint_*'")
    return patterns


def _matches(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatch.fnmatchcase(name.lower(), pattern.lower()) for pattern in patterns)
