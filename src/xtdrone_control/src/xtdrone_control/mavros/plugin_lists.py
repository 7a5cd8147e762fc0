"""Selection of plugins by MAVROS's lists of shell patterns.

MAVROS 1.x calls the lists ``plugin_blacklist`` and ``plugin_whitelist``, MAVROS 2.x ``plugin_denylist`` and
``plugin_allowlist``; both names are equivalent. The rules are those of MAVROS's ``mavros.cpp``: a plugin is
skipped if a denied pattern matches its name and no allowed one does; with only allowed patterns, all others are denied.
Matching ignores case.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from xtdrone_control.mavros.lib.plugin_settings import ParamError, Params

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
