"""Joints of vehicles that a request can set: those of gimbals and landing gears."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from xtdrone_sim.gazebo.request_limits import RequestError
from xtdrone_sim.simulation import Simulation


def set_joints(
    simulation: Simulation, vehicle: int, names: Sequence[str], positions: Sequence[float]
) -> Callable[[], str]:
    """Return the change that sets joints to positions, from which their drives continue to move them.

    Args:
        simulation: the simulation.
        vehicle: index of the vehicle.
        names: of the joints; the joints of a landing gear move together.
        positions: rad, as many as names.

    Raises:
        RequestError: a joint cannot be set, or a position is outside its limits.
    """
    if len(names) != len(positions):
        raise RequestError(f"joint_positions: {len(positions)} are not allowed for {len(names)} joint_names")
    changes = [_setting(simulation, vehicle, name, value) for name, value in zip(names, positions, strict=True)]
    vehicle_name = simulation.names[vehicle]

    def change() -> str:
        for set_one in changes:
            set_one()
        return f"joints of {vehicle_name} are set: {', '.join(names) or 'none'}"

    return change


def _setting(simulation: Simulation, vehicle: int, name: str, value: float) -> Callable[[], None]:
    model = simulation.models[vehicle]
    joints = list(model.gimbal.joints) if model.gimbal is not None else []
    settable = [*joints, *model.landing_gear]
    joint = next((one for one in settable if one.name == name), None)
    if joint is None:
        known = ", ".join(one.name for one in settable) or "none"
        raise RequestError(f"joint_names: {name!r} cannot be set; joints that can are {known}")
    if not (math.isfinite(value) and joint.lower <= value <= joint.upper):
        raise RequestError(f"{name}: {value:g} rad is not allowed, {joint.lower:g} to {joint.upper:g} rad")

    def turn() -> None:
        if joint in joints:
            number = joints.index(joint)
            assert model.gimbal is not None
            simulation.gimbals.records["joint"][vehicle, number] = model.gimbal.signs[number] * value
        else:
            simulation.landing_gears.records["raised"][vehicle] = value / joint.upper

    return turn
