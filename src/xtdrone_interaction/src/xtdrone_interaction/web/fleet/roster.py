"""The roster: the vehicles and other models, in the order of the fleet frame's rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.fleet import Vehicle
from xtdrone_interaction.web.fleet.model_states_bytes import COLUMNS, ModelRows

_GROUND = "ground_plane"


class Roster:
    """Sorts the models of the simulation into vehicles, other moving models and static models.

    Attributes:
        version: counts changes.
    """

    def __init__(self) -> None:
        self.version = 0
        self._fleet: tuple[Vehicle, ...] = ()
        self._names: tuple[str, ...] | None = None
        self._moving: list[str] = []
        self._first = np.empty((0, COLUMNS))
        self._vehicle_rows = np.empty(0, int)
        self._other_rows = np.empty(0, int)
        self._mover_rows = np.empty(0, int)

    def set_fleet(self, fleet: Sequence[Vehicle]) -> None:
        """Set the vehicles of the parameter /xtdrone/fleet."""
        if tuple(fleet) != self._fleet:
            self._fleet, self._names = tuple(fleet), None
            self.version += 1

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """The vehicles, in the order of the rows."""
        return self._fleet

    def split(self, models: ModelRows) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the rows of vehicles and of other models that move or have moved; NaN for absent vehicles."""
        if models.names is not self._names:
            self._sort(models)
        rows = models.rows
        others = self._other_rows
        stirred = others[np.any(rows[others, :7] != self._first[others, :7], axis=1)] if len(others) else others
        if len(stirred):
            self._set_moving([*self._moving, *(models.names[i] for i in stirred)], models.names)
        known = np.where(self._vehicle_rows >= 0, self._vehicle_rows, 0)
        vehicles = np.where((self._vehicle_rows >= 0)[:, None], rows[known], np.nan)
        return vehicles, rows[self._mover_rows]

    def describe(self, models: ModelRows | None) -> dict[str, Any]:
        """Return the data that a page needs only once per version.

        Returns:
            The version; name, type and model of each vehicle; names of the movers; and the place of each other model
            by its name, as the row of the frame.
        """
        places = {} if models is None else dict(zip(models.names, models.rows.tolist(), strict=True))
        vehicles = {vehicle.name for vehicle in self._fleet}
        return {
            "version": self.version,
            "vehicles": [{"name": v.name, "type": v.type, "model": v.model} for v in self._fleet],
            "movers": list(self._moving),
            "places": {name: row for name, row in places.items() if name not in vehicles and name != _GROUND},
        }

    def _sort(self, models: ModelRows) -> None:
        number = {name: i for i, name in enumerate(models.names)}
        self._names = models.names
        self._vehicle_rows = np.array([number.get(vehicle.name, -1) for vehicle in self._fleet], int)
        self._first = models.rows.copy()
        self._set_moving([name for name in self._moving if name in number], models.names)

    def _set_moving(self, moving: list[str], names: Sequence[str]) -> None:
        number = {name: i for i, name in enumerate(names)}
        vehicles = {vehicle.name for vehicle in self._fleet}
        self._moving = moving
        self._mover_rows = np.array([number[name] for name in moving], int)
        still = [i for i, name in enumerate(names) if name not in vehicles and name not in moving and name != _GROUND]
        self._other_rows = np.array(still, int)
        self.version += 1
