"""Wind given by a user's function of time and position."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.programs.user_classes import import_user_module
from xtdrone_sim.kernel import kernel

from .wind import add_wind


@kernel
def _apply(vehicles, models, wind, force, torque):
    for i in range(len(vehicles)):
        add_wind(vehicles[i], models[i], wind[i, 0], wind[i, 1], wind[i, 2], force[i], torque[i])


class WindField:
    """Wind of a function ``wind(time, positions)``: s and (N, 3) m ENU to (N, 3) or (3,) m/s ENU."""

    name = "wind_field"

    def __init__(self, function: str | Callable[[float, NDArray[np.float64]], Any]) -> None:
        """Create it.

        Args:
            function: the function, or ``FILE.py:NAME`` or ``module:NAME``.

        Raises:
            ValueError: the text does not have this form.
        """
        if isinstance(function, str):
            place, _, name = function.rpartition(":")
            if not place or not name:
                raise ValueError(f"function: {function!r} is not allowed, FILE.py:NAME or module:NAME")
            function = getattr(import_user_module(place), name)
        if not callable(function):
            raise ValueError(f"function: {function!r} is not allowed, a function (time, positions)")
        self._function = function
        self.winds: NDArray[Any] = np.zeros((0, 3))

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Add the wrench of the wind at each vehicle.

        Raises:
            ValueError: the function returns an array of another shape.
        """
        given = np.asarray(self._function(time, np.ascontiguousarray(vehicles["position"])), dtype=float)
        if given.shape not in ((3,), (len(vehicles), 3)):
            raise ValueError(f"the wind has the shape {given.shape}, it must be ({len(vehicles)}, 3) or (3,)")
        self.winds = np.ascontiguousarray(np.broadcast_to(given, (len(vehicles), 3)))
        _apply(vehicles, models, self.winds, force, torque)
