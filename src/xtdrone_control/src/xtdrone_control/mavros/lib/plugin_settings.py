"""Settings of one vehicle's plugins, by MAVROS's parameter names."""

from __future__ import annotations

from collections.abc import Mapping
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
        return _checked(name, self.get_any(name, default), default)

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


def _checked(name: str, value: Any, default: T) -> T:
    kind = type(default)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise ParamError(f"parameter {name}: {value!r} is not of type {kind.__name__}")
    return value
