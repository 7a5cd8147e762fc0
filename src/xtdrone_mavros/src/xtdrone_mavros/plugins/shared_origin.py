"""Common local frame for all PX4 instances of a simulation: moves each origin from its spawn point to the world's.

PX4's local frame starts at the first position of its estimator. The simulator's parameter ``/xtdrone/shared_origin``
(latitude and longitude in degrees, altitude in m AMSL) sets the common origin. Without it nothing is sent, as for the
built-in autopilots, whose frames start at the world's origin anyway. Real MAVROS has no equivalent.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_autopilot.vehicle_view import is_origin
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

log = logging.getLogger("rosout.mavros")

PARAMETER = "/xtdrone/shared_origin"
PERIOD = 0.5  # s of ROS time between requests or attempts
MOST_TRIES = 10
_MOST_DEGREES = 1  # 1e-7 deg, about a centimetre: rounding between degrees and PX4's radians
_MOST_HEIGHT = 10  # mm; PX4 ignores smaller changes


class Origin(NamedTuple):
    """A local frame's origin in MAVLink's units: 1e-7 deg, 1e-7 deg, mm AMSL."""

    latitude: int
    longitude: int
    altitude: int

    def __str__(self) -> str:
        """Return the origin for log messages."""
        return f"{self.latitude * 1e-7:.7f} deg, {self.longitude * 1e-7:.7f} deg, {self.altitude * 1e-3:.3f} m AMSL"

    def agrees(self, other: Origin) -> bool:
        """Return whether both origins are equal to a centimetre."""
        return (
            abs(self.latitude - other.latitude) <= _MOST_DEGREES
            and abs(self.longitude - other.longitude) <= _MOST_DEGREES
            and abs(self.altitude - other.altitude) <= _MOST_HEIGHT
        )


def parse_origin(value: Any) -> Origin | None:
    """Parse ``/xtdrone/shared_origin``; return None if it is empty.

    Raises:
        ValueError: the value is not a position.
    """
    if not value:
        return None
    try:
        place = float(value["latitude"]), float(value["longitude"]), float(value["altitude"])
    except (KeyError, TypeError, ValueError):
        place = None
    if not isinstance(value, Mapping) or place is None or not is_origin(*place):
        raise ValueError(
            f"{PARAMETER}: {value!r} is not allowed, latitude and longitude (deg) and altitude (m AMSL) of a place are"
        )
    latitude, longitude, altitude = place
    return Origin(round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3))


class SharedOriginPlugin(Plugin):
    """Requests the origin of the autopilot's local frame, and sets it until it equals the shared one.

    PX4 reports no origin before it has a position. It acknowledges SET_GPS_GLOBAL_ORIGIN immediately, before its
    estimator acts, so the answer to an attempt may still be the old origin; some versions ignore it in the air (PX4's
    mavlink_receiver.cpp and EKF2.cpp). From the first answer until the frames agree, or all attempts have failed, this
    layer does not arm the vehicle.
    """

    name = "shared_origin"

    def __init__(self, uas: Uas) -> None:
        """Read the parameter and start the timer."""
        super().__init__(uas)
        self._wanted: Origin | None = None
        self._heard: Origin | None = None
        self._tries = 0
        self._feed = Feed(self._on_origin)
        self.messages = {"GPS_GLOBAL_ORIGIN": self._feed}
        uas.timer(PERIOD, self._poll)

    def connected(self, connected: bool) -> None:
        """Start over when the autopilot connects or reboots."""
        self._heard, self._tries = None, 0
        self.uas.arming_held = ""
        try:
            self._wanted = parse_origin(self.uas.ros.get_param(PARAMETER, {})) if connected else None
        except ValueError as error:
            self._wanted = None
            log.error("%s: %s", self.uas.name, error)
        self._feed.always = self._wanted is not None

    def _on_origin(self, origin: Any) -> None:
        if self._wanted is None:
            return
        before, self._heard = self._heard, Origin(origin.latitude, origin.longitude, origin.altitude)
        if not self._wanted.agrees(self._heard):
            if self._tries < MOST_TRIES:
                self.uas.arming_held = f"the origin of its local frame is {self._heard}, and has to be {self._wanted}"
            return
        self._tries = 0
        self.uas.arming_held = ""
        if before is None or not self._wanted.agrees(before):
            log.info("%s: the local frame begins at the shared origin, %s", self.uas.name, self._wanted)

    def _poll(self) -> None:
        """Request or set the origin, once per period."""
        if self._wanted is None:
            return
        if self._heard is None:
            self._ask()
        elif not self._wanted.agrees(self._heard) and self._tries <= MOST_TRIES:
            self._try(self._wanted, self._heard)

    def _ask(self) -> None:
        system, component = self.uas.target
        command, number = mavlink.MAV_CMD_REQUEST_MESSAGE, float(MESSAGE_ID["GPS_GLOBAL_ORIGIN"])
        self.uas.commands.send(
            command, mavlink.MAVLink_command_long_message(system, component, command, 0, number, *[0.0] * 6)
        )

    def _try(self, wanted: Origin, heard: Origin) -> None:
        """Set the origin; after the last failed attempt, log it once and allow arming."""
        self._tries += 1
        if self._tries <= MOST_TRIES:
            self.uas.link.send(mavlink.MAVLink_set_gps_global_origin_message(self.uas.target[0], *wanted))
            return
        self.uas.arming_held = ""
        log.warning(
            "%s: the local frame begins at %s, not at the shared origin, %s, which was sent %d times: "
            "its local positions are not those of the others",
            self.uas.name,
            heard,
            wanted,
            MOST_TRIES,
        )
