"""Parameters of ROS, with their declarations in the settings, and of the autopilots, with PX4's definitions."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import rosgraph
from mavros_msgs.msg import ParamValue
from mavros_msgs.srv import ParamPull, ParamPullRequest, ParamSet, ParamSetRequest

from xtdrone_autopilot.parameters.metadata import parameter_definitions
from xtdrone_autopilot.parameters.parameters import NAMES, Parameters
from xtdrone_interaction import command_options
from xtdrone_interaction.parameter_secrets import is_secret, without_secrets
from xtdrone_interaction.simulation_services import SimError, call
from xtdrone_interaction.topics.ros_names import absolute_name
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.parameters.declared_settings import Tables, declared_for, read_declared
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session

_PAGE = "docs/settings.md"
_MIRROR = "param"  # below a vehicle's MAVROS, where it keeps its values on the parameter server
_PULL_LIMIT = 60.0  # s of wall time
_LONGEST = 10_000  # characters of a value
_DEEPEST = 8


class ParameterRoom:
    """Reads and sets parameters for pages."""

    def __init__(self, context: StationContext) -> None:
        """Store the context that the rooms share."""
        self._context = context
        self._master = rosgraph.Master(context.name, context.master)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("parameters.ros", self._ros),
            Method("parameters.set_ros", self._set_ros, "operate"),
            Method("parameters.definitions", self._definitions),
            Method("parameters.vehicle", self._vehicle),
            Method("parameters.pull", self._pull, "operate"),
            Method("parameters.set_vehicle", self._set_vehicle, "operate"),
        ]

    async def _ros(self, _session: Session, _params: Params) -> dict[str, Any]:
        tree = await self._context.blocking(self._call, self._master.getParam, "/")
        flat = {name: value for name, value in flattened(without_secrets(tree)).items() if f"/{_MIRROR}/" not in name}
        tables = _tables()
        about = {name: vars(found) for name in flat if (found := declared_for(tables, name)) is not None}
        return {"values": dict(sorted(flat.items())), "declared": about}

    async def _set_ros(self, _session: Session, params: Params) -> None:
        name = absolute_name(needed(params, "name", str, "a parameter's name such as /simulator/speed"), "name")
        if is_secret(name):
            raise CallError(f"name: {name!r} is not allowed, a parameter that is no token")
        value = params.get("value")
        check_ros_value(name, value)
        await self._context.blocking(self._call, self._master.setParam, name, value)

    def _definitions(self, _session: Session, _params: Params) -> Any:
        return _px4_definitions()

    async def _vehicle(self, _session: Session, params: Params) -> dict[str, Any]:
        """Return the vehicle's parameters that MAVROS has read so far, without a request to the vehicle."""
        try:
            prefix = f"{self._prefix(params)}/{_MIRROR}"
            values = await self._context.blocking(self._call, self._master.getParam, prefix)
        except CallError:
            values = {}  # before the first request
        return {"values": values if isinstance(values, dict) else {}}

    async def _pull(self, session: Session, params: Params) -> dict[str, Any]:
        service = f"{self._prefix(params)}/param/pull"
        answer = await self._service(service, ParamPull, ParamPullRequest(force_pull=False), _PULL_LIMIT)
        if not answer.success:
            raise CallError(f"{service}: the vehicle has sent only {answer.param_received} parameters")
        found: dict[str, Any] = await self._vehicle(session, params)
        return found

    async def _set_vehicle(self, _session: Session, params: Params) -> dict[str, Any]:
        name = needed(params, "name", str, "a parameter's name such as MPC_XY_VEL_MAX")
        definition = _px4_definitions().get(name)
        if definition is None:
            raise CallError(f"name: {name[:40]!r} is not allowed, a parameter of PX4 such as MPC_XY_VEL_MAX")
        value = px4_value(name, definition, params.get("value"))
        service = f"{self._prefix(params)}/param/set"
        answer = await self._service(service, ParamSet, ParamSetRequest(param_id=name, value=value), None)
        if not answer.success:
            raise CallError(f"{name}: {params.get('value')} was not accepted by the vehicle")
        return {"value": answer.value.integer or answer.value.real}

    async def _service(self, name: str, kind: Any, request: Any, limit: float | None) -> Any:
        arguments = (self._context.master, name, kind, request)
        try:
            return await self._context.blocking(call, *arguments, **({"limit": limit} if limit else {}))
        except SimError as error:
            raise CallError(f"{name}: {error}") from error

    def _prefix(self, params: Params) -> str:
        vehicle = needed(params, "vehicle", str, "a vehicle's name such as iris_0")
        if not vehicle.replace("_", "").isalnum() or not vehicle.isascii():
            raise CallError(f"vehicle: {vehicle[:60]!r} is not allowed, a vehicle's name such as iris_0")
        return f"/{vehicle}/mavros"

    @staticmethod
    def _call(method: Any, *arguments: Any) -> Any:
        try:
            return method(*arguments)
        except (rosgraph.MasterException, OSError) as error:
            raise CallError(f"parameter: {error}") from error


def flattened(tree: object, prefix: str = "") -> dict[str, Any]:
    """Return the leaves of the parameter server's tree by their full names; empty namespaces are left out."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= flattened(value, f"{prefix}/{name}")
    return found


def check_ros_value(name: str, value: Any, depth: int = 0) -> None:
    """Check that the parameter server can hold a value.

    Raises:
        CallError: it cannot: null, numbers that are not finite or beyond 32 bits, or too much of it.
    """
    if depth == 0 and len(json.dumps(value)) > _LONGEST:
        raise CallError(f"{name}: {len(json.dumps(value))} characters are not allowed, at most {_LONGEST}")
    if isinstance(value, list) and depth < _DEEPEST:
        for entry in value:
            check_ros_value(name, entry, depth + 1)
        return
    if isinstance(value, dict) and depth < _DEEPEST:
        for entry in value.values():
            check_ros_value(name, entry, depth + 1)
        return
    fits = isinstance(value, (bool, str)) or (type(value) is int and -(2**31) <= value < 2**31)
    if not fits and not (type(value) is float and math.isfinite(value)):
        allowed = "a text, a finite number (integers of 32 bits), true, false, or a list or object of these"
        raise CallError(f"{name}: {str(value)[:60]} is not allowed, {allowed}")


def px4_value(name: str, definition: Mapping[str, Any], value: Any) -> ParamValue:
    """Return a value for MAVROS's service.

    Raises:
        CallError: it is no number of the parameter's type, or outside its range.
    """
    low, high = definition.get("min", -math.inf), definition.get("max", math.inf)
    unit = f" {definition['units']}" if "units" in definition else ""
    integer = definition["type"] == "Int32"
    kind = "an integer" if integer else "a number"
    if (
        type(value) not in (int, float)
        or not math.isfinite(value)
        or not low <= value <= high
        or (integer and value != int(value))
    ):
        limits = f" from {low:g} to {high:g}{unit}" if math.isfinite(low) and math.isfinite(high) else unit
        raise CallError(f"{name}: {str(value)[:40]} is not allowed, {kind}{limits}")
    return ParamValue(int(value), 0.0) if integer else ParamValue(0, float(value))


@cache
def _px4_definitions() -> dict[str, dict[str, Any]]:
    entries = json.loads(parameter_definitions(Parameters()))["parameters"]
    found = {entry["name"]: entry for entry in entries}
    return {name: found[name] for name in NAMES}


@cache
def _tables() -> Tables:
    try:
        return read_declared((command_options.repository() / _PAGE).read_text(encoding="utf-8"))
    except OSError:
        return {}
