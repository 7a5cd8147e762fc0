"""The simplified vehicle model: its parameters, validated and as a record for the kernels.

Order 1: the velocity equals the commanded one, within the speed limits. Order 2: the commanded velocity, within the
speed limits, acts after a delay, and the velocity follows it with a lag of limited acceleration:

    v' = (c(t - delay) - v) / time_constant,  |v'| <= acceleration

horizontally as a vector and vertically as a separate axis. A position setpoint is a velocity setpoint proportional to
the distance, as in PX4's position controller. Both orders are computed exactly from base step to base step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_worlds.descriptions import ModelError, read_description

SECTION = "simplified"
ORDERS = {"first-order": 1, "second-order": 2}
_MOST_DELAY = 10.0  # s

MODEL = np.dtype(
    [
        ("order", "i8"),
        ("time_constant", "f8", 2),  # s, horizontal and vertical, like all pairs here
        ("keep", "f8", 2),  # share of a velocity error left after a step while the acceleration is below its limit
        ("acceleration", "f8", 2),  # m/s^2
        ("gain", "f8", 2),  # 1/s
        ("delay", "i8", 2),  # steps
        ("speed", "f8"),  # m/s
        ("speed_up", "f8"),
        ("speed_down", "f8"),
        ("yaw_rate", "f8"),  # rad/s
        ("yaw_gain", "f8"),  # 1/s
    ],
    align=True,
)


@dataclass(frozen=True)
class Model:
    """Parameters of a simplified vehicle. The defaults are those of the iris, see ``config/vehicles/iris.yaml``.

    Attributes:
        order: 1 or 2; time constants, accelerations and delays apply to order 2 only.
        time_constant: time constant of the horizontal velocity, s, above 0.
        time_constant_vertical: time constant of the vertical velocity, s, above 0.
        speed: maximum horizontal speed, m/s, above 0.
        speed_up: maximum climb rate, m/s, above 0.
        speed_down: maximum sink rate, m/s, above 0.
        acceleration: maximum horizontal acceleration, m/s^2, above 0, may be infinite.
        acceleration_vertical: maximum vertical acceleration, up and down, likewise.
        delay: delay of a horizontal command, s, 0 to 10, rounded to the nearest base step.
        delay_vertical: delay of a vertical command, likewise.
        position_gain: horizontal velocity per distance to a position setpoint, 1/s, above 0.
        position_gain_vertical: vertical velocity per distance, likewise.
        yaw_rate: maximum yaw rate, rad/s, above 0.
        yaw_gain: yaw rate per heading error, 1/s, above 0.
    """

    order: int = 2
    time_constant: float = 0.56
    time_constant_vertical: float = 0.126
    speed: float = 12.0
    speed_up: float = 3.0
    speed_down: float = 1.5
    acceleration: float = 8.6
    acceleration_vertical: float = 8.0
    delay: float = 0.145
    delay_vertical: float = 0.023
    position_gain: float = 0.95
    position_gain_vertical: float = 1.0
    yaw_rate: float = 3.5
    yaw_gain: float = 2.8

    def __post_init__(self) -> None:
        """Validate all values.

        Raises:
            ModelError: a value is not a number or out of range.
        """
        if isinstance(self.order, bool) or self.order not in (1, 2):
            raise ModelError(f"model: order {self.order!r} is not allowed, 1 or 2")
        for field in fields(self):
            if field.name != "order":
                _check(field.name, getattr(self, field.name))

    def record(self, step_us: int) -> NDArray[np.void]:
        """Return the model as an array of one ``MODEL`` record, for base steps of ``step_us`` microseconds."""
        record = np.zeros(1, MODEL)
        step = step_us * 1e-6
        constants = np.array([self.time_constant, self.time_constant_vertical])
        delays = np.array([self.delay, self.delay_vertical]) / step
        record["order"] = self.order
        record["time_constant"] = constants
        record["keep"] = [math.exp(-step / constant) for constant in constants]
        record["acceleration"] = self.acceleration, self.acceleration_vertical
        record["gain"] = self.position_gain, self.position_gain_vertical
        record["delay"] = np.rint(delays) if self.order == 2 else 0
        for name in ("speed", "speed_up", "speed_down", "yaw_rate", "yaw_gain"):
            record[name] = getattr(self, name)
        return record


def load_model(kind: str, model: Model | str | None = None) -> Model:
    """Return the model of the simplified vehicles.

    Args:
        kind: vehicle type, a name in ``config/vehicles`` or a YAML file; its section ``simplified:`` provides values
            that ``model`` does not give.
        model: a model to return unchanged; ``first-order`` or ``second-order``: the type's model with that order; a
            file name (``.yaml``): values that replace the type's; None: the type's model.

    Raises:
        ModelError: unknown type or model, type without that section, unknown field or invalid value.
    """
    if isinstance(model, Model):
        return model
    described = read_description("vehicles", kind).get(SECTION)
    if described is None:
        raise ModelError(f"vehicle {kind!r} has no section {SECTION!r}: give a model, as Model(order=1)")
    base = _replace(Model(), described, f"vehicle {kind!r}, section {SECTION!r}")
    if model is None:
        return base
    if isinstance(model, str) and model in ORDERS:
        return replace(base, order=ORDERS[model])
    if isinstance(model, str) and model.endswith((".yaml", ".yml")):
        return _replace(base, read_description("vehicles", model), model)
    raise ModelError(f"model {model!r} is not known; {', '.join(ORDERS)}, a YAML file's name or a Model")


def _replace(base: Model, values: Any, source: str) -> Model:
    if not isinstance(values, Mapping):
        raise ModelError(f"{source}: a mapping is needed, got {type(values).__name__}")
    known = [field.name for field in fields(Model)]
    for name in values:
        if name not in known:
            raise ModelError(f"{source}: field {name!r} is not known; there are {', '.join(known)}")
    try:
        return replace(base, **values)
    except ModelError as error:
        raise ModelError(f"{source}: {error}") from error


def _check(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise ModelError(f"model: {name}: {value!r} is not a number")
    if name.startswith("delay"):
        if not 0.0 <= value <= _MOST_DELAY:
            raise ModelError(f"model: {name}: {value} s is not allowed, 0 to {_MOST_DELAY:g} s")
        return
    if value <= 0.0 or (math.isinf(value) and not name.startswith("acceleration")):
        raise ModelError(f"model: {name}: {value} is not allowed, above 0 and finite")
