"""Home position of one vehicle, after PX4 v1.14's ``HomePosition.cpp`` and its calls in ``Commander.cpp``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from xtdrone_autopilot.flight_tasks.auto_setpoint import Home
from xtdrone_autopilot.navigator.navigator import Navigator
from xtdrone_autopilot.vehicle_view import Vector, VehicleView


class HomePosition:
    """Sets the navigator's home: here, by a command, or by itself where COM_HOME_EN allows it."""

    def __init__(self, view: VehicleView, navigator: Navigator, get: Callable[[str], float]) -> None:
        """Leave home unset until ``update``.

        Args:
            view: access to the vehicle's autopilot records.
            navigator: holder of the home position.
            get: returns a parameter's value.
        """
        self._view = view
        self._navigator = navigator
        self._get = get
        self._eph, self._epv = view.cell("estimator", "eph"), view.cell("estimator", "epv")
        self._heading_resets = view.cell("estimator", "resets", "heading")
        self._resets_seen = self._heading_resets[0]
        self._local: tuple[Vector, float] | None = None  # position and heading on the ground without a global position

    @property
    def enabled(self) -> bool:
        """Whether home may be set at all (COM_HOME_EN)."""
        return bool(int(self._get("COM_HOME_EN")))

    def set_here(self, *, force: bool = False) -> bool:
        """Set home to the vehicle's position, in place of a manual one only with ``force``.

        Returns:
            Whether home was set, which needs a global position.
        """
        home, view = self._navigator.home, self._view
        if home is not None and home.manual and not force:
            return False
        position = view.position
        if not view.global_valid:
            if view.position_valid:
                self._local = position, view.yaw
            return False
        self._navigator.home = Home(*view.to_global(position), position, view.yaw, view.time_us)
        return True

    def set_manually(self, location: Vector, yaw: float) -> bool:
        """Set home to ``location`` (degrees, m AMSL) and ``yaw`` (rad, NaN if unknown); it stays there.

        Returns:
            Whether home was set, which needs a global position.
        """
        view = self._view
        if not view.global_valid:
            return False
        self._navigator.home = Home(*location, view.to_local(*location), yaw % math.tau, view.time_us, manual=True)
        return True

    def set_if_enabled(self) -> None:
        """Set home to the vehicle's position, as an arming command and a takeoff do, unless COM_HOME_EN forbids it."""
        if self.enabled:
            self.set_here()

    def update(self, armed: bool) -> None:
        """Let home follow a disarmed vehicle on the ground, and set a missing one; call at 10 Hz."""
        self._follow_heading()
        if not self.enabled:
            return
        landed = self._view.landed
        if not armed and landed:
            if self._navigator.home is None or self._has_moved(self._navigator.home):
                self.set_here()
        elif armed and not landed and self._navigator.home is None and int(self._get("COM_HOME_IN_AIR")):
            self._set_in_air()

    def _has_moved(self, home: Home) -> bool:
        """Return whether the vehicle is farther from home than twice the accuracy of the local estimate."""
        if not self._view.position_valid:
            return False
        north, east, down = (a - b for a, b in zip(self._view.position, home.position, strict=True))
        return math.hypot(north, east) > 2.0 * self._eph[0] or abs(down) > 2.0 * self._epv[0]

    def _set_in_air(self) -> None:
        """Set home to the place of the takeoff, at the vehicle's altitude, as PX4 v1.14 does; without one, here."""
        if self._local is None:
            self.set_here()
        if self._local is None or not self._view.global_valid:
            return
        position, yaw = self._local
        latitude, longitude, _ = self._view.to_global(position)
        altitude = self._view.to_global(self._view.position)[2] + position[2]
        self._navigator.home = Home(latitude, longitude, altitude, position, yaw, self._view.time_us)

    def _follow_heading(self) -> None:
        resets = self._heading_resets[0]
        if resets == self._resets_seen:
            return
        self._resets_seen = resets
        home = self._navigator.home
        if home is not None and self.enabled:
            turn = float(self._view.estimator["shifts"]["heading"])
            self._navigator.home = replace(home, yaw=home.yaw + turn, time_us=self._view.time_us)
