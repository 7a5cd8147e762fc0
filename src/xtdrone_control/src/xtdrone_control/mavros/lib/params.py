"""Settings of one vehicle's plugins, by MAVROS's parameter names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

T = TypeVar("T", bool, int, float, str, list[Any], dict[str, Any])


class ParamError(ValueError):
    """A parameter with a value of the wrong type."""


class Params:
    """Looks a name up in several trees, the first that has it wins.

    The trees are those of the vehicle (``/iris_0/mavros/...``, where real MAVROS has them) and of the node, which hold
    for every vehicle.
    """

    def __init__(self, *trees: Mapping[str, Any]) -> None:
        """Take nested dictionaries as rospy.get_param gives them, the most specific first."""
        self._trees = trees

    def get(self, name: str, default: T) -> T:
        """Return parameter ``name`` (as ``local_position/tf/send``), or ``default``.

        Raises:
            ParamError: the value is not of the default's type (an int passes for a float).
        """
        return _checked(name, self.get_any(name, default), default)

    def get_any(self, name: str, default: Any) -> Any:
        """Return parameter ``name``, of whatever type, or ``default``."""
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
