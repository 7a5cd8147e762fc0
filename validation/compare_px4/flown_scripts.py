"""The flights, each flown as the recorded PX4 was: same commands at the same times within each phase."""

from __future__ import annotations

import math
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from validation.compare_px4.pilot import Pilot
from validation.compare_px4.reference import Flight
from xtdrone_common import modes

_NAN = math.nan
_UNSET = (_NAN, _NAN, _NAN)
_SIDE = 20.0  # m, of the mission's square
_MISSION_HEIGHT = 10.0  # m

FLIGHTS = ("takeoff", "position_step", "velocity_step", "yaw_step", "offboard_loss", "mission", "rtl")
_OFFBOARD_FLIGHTS = {"position_step", "velocity_step", "yaw_step", "offboard_loss"}


def needed(wanted: tuple[str, ...]) -> tuple[str, ...]:
    """Return ``wanted`` with the flights they depend on, in order."""
    wishes = set(wanted)
    if wishes & _OFFBOARD_FLIGHTS:
        wishes.add("takeoff")
    if "rtl" in wishes:
        wishes.add("mission")
    return tuple(name for name in FLIGHTS if name in wishes)


def fly(vehicle: str, wanted: tuple[str, ...], seed: int, progress: Callable[[str], None]) -> Flight:
    """Fly ``wanted`` (names of ``FLIGHTS``) on ``vehicle`` and return the recording.

    Raises:
        ModelError, OSError, PilotError: see ``Pilot``.
    """
    pilot = Pilot(vehicle, seed)
    try:
        script = _Script(pilot)
        for name in needed(wanted):
            progress(name)
            getattr(script, name)()
        return pilot.flight
    finally:
        pilot.close()


class _Script:
    """Flies the flights one after the other with one vehicle."""

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot
        self._corner = (0.0, 0.0)
        self._hold = (0.0, 0.0, -5.0)
        pilot.run(8.0)  # the estimator settles
        pilot.set_parameter("MIS_TAKEOFF_ALT", 5.0)
        pilot.look_ahead()
        pilot.begin("ready")
        pilot.set_mode(modes.AUTO_LOITER)
        pilot.run(1.0)

    def takeoff(self) -> None:
        pilot = self._pilot
        pilot.begin("takeoff")
        pilot.run(1.0)
        pilot.set_mode(modes.AUTO_TAKEOFF)
        pilot.run(0.312)
        pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        pilot.run(38.228)

    def position_step(self) -> None:
        pilot = self._pilot
        pilot.begin("offb_pos")
        pilot.run(0.06)
        pilot.set_mode(modes.OFFBOARD)
        pilot.run(0.5)
        self._enter_offboard("")
        pilot.run(4.016)
        x, y, z = self._hold
        pilot.begin("offb_pos_step")
        pilot.setpoint = ((x + 5.0, y, z), _UNSET, 0.0)
        pilot.run(12.0)
        pilot.begin("offb_pos_back")
        pilot.setpoint = (self._hold, _UNSET, 0.0)
        pilot.run(10.0)

    def _enter_offboard(self, phase: str) -> None:
        """Send setpoints for 2 s, then request OFFBOARD; do nothing in OFFBOARD."""
        pilot = self._pilot
        if phase:
            pilot.begin(phase)
        if pilot.setpoint is not None:
            return
        self._hold = (pilot.position[0], pilot.position[1], -5.0)
        pilot.setpoint = (self._hold, _UNSET, 0.0)
        pilot.run(2.0)
        pilot.set_mode(modes.OFFBOARD)
        if not phase:
            return
        pilot.run(4.0)

    def velocity_step(self) -> None:
        pilot = self._pilot
        self._enter_offboard("offb_vel")
        pilot.setpoint = (_UNSET, (0.0, 0.0, 0.0), 0.0)
        pilot.run(3.052)
        pilot.begin("offb_vel_step")
        pilot.setpoint = (_UNSET, (3.0, 0.0, 0.0), 0.0)
        pilot.run(8.0)
        pilot.begin("offb_vel_stop")
        pilot.setpoint = (_UNSET, (0.0, 0.0, 0.0), 0.0)
        pilot.run(6.0)
        pilot.begin("offb_vel_back")
        pilot.setpoint = (self._hold, _UNSET, 0.0)
        pilot.run(14.0)

    def yaw_step(self) -> None:
        pilot = self._pilot
        self._enter_offboard("yaw")
        pilot.run(3.052)
        pilot.begin("yaw_step")
        pilot.setpoint = (self._hold, _UNSET, 0.5 * math.pi)
        pilot.run(8.0)
        pilot.begin("yaw_back")
        pilot.setpoint = (self._hold, _UNSET, 0.0)
        pilot.run(8.0)

    def offboard_loss(self) -> None:
        pilot = self._pilot
        self._enter_offboard("offb_hold")
        pilot.begin("offboard_loss")
        x, y, z = self._hold
        pilot.setpoint = ((x + 5.0, y, z), _UNSET, 0.0)
        pilot.run(2.052)
        pilot.note_setpoints_stopped()
        pilot.run(7.28)
        pilot.set_mode(modes.AUTO_LOITER)
        pilot.run(4.0)
        pilot.begin("land")
        pilot.set_mode(modes.AUTO_LAND)
        pilot.run_until(lambda: not pilot.armed, 40.0)
        pilot.run(1.0)

    def mission(self) -> None:
        pilot = self._pilot
        pilot.begin("mission_upload")
        forward, right, _ = pilot.position
        self._corner = (forward, right)
        corners = ((0.0, 0.0), (_SIDE, 0.0), (_SIDE, _SIDE), (0.0, _SIDE), (0.0, 0.0))
        commands = (mavlink.MAV_CMD_NAV_TAKEOFF, *[mavlink.MAV_CMD_NAV_WAYPOINT] * 4)
        pilot.upload_mission(
            [
                (command, forward + x, right + y, _MISSION_HEIGHT)
                for command, (x, y) in zip(commands, corners, strict=True)
            ]
        )
        pilot.begin("mission")
        pilot.set_mode(modes.AUTO_MISSION)
        pilot.run(1.316)
        pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        if pilot.run_until(lambda: any("Mission finished" in text for text in pilot.texts), 80.0):
            pilot.run(6.0)

    def rtl(self) -> None:
        pilot = self._pilot
        pilot.begin("goto_away")
        altitude = -pilot.position[2]
        pilot.reposition(self._corner[0] + 30.0, self._corner[1] + 10.0, altitude)
        pilot.run(14.55)
        pilot.begin("rtl")
        pilot.set_mode(modes.AUTO_RTL)
        pilot.run_until(lambda: not pilot.armed, 120.0)
        pilot.run(1.0)
