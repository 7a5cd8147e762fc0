"""One local frame for all PX4s of a simulation: each is moved from its own spawn place to the world's origin.

PX4's local frame begins where its estimator got its first position. The simulator's parameter
``/xtdrone/shared_origin`` (latitude and longitude in degrees, altitude in m AMSL) says where all are to begin; without
it nothing is sent, as with our own autopilots, whose frames begin at the world's origin anyway. Real MAVROS has nothing
like this.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.estimator.origin import is_origin
from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_control.mavros.plugin import Feed, Plugin
from xtdrone_control.mavros.uas import Uas

log = logging.getLogger("rosout.mavros")

PARAMETER = "/xtdrone/shared_origin"
PERIOD = 0.5  # s of ROS time between two questions or tries
MOST_TRIES = 10
_MOST_DEGREES = 1  # 1e-7 deg, a centimetre: what is lost between degrees and the radians that PX4 keeps
_MOST_HEIGHT = 10  # mm; PX4 does not move its frame by less


class Origin(NamedTuple):
    """A local frame's origin as MAVLink has it: 1e-7 deg, 1e-7 deg, mm AMSL."""

    latitude: int
    longitude: int
    altitude: int

    def __str__(self) -> str:
        """Return it for a log."""
        return f"{self.latitude * 1e-7:.7f} deg, {self.longitude * 1e-7:.7f} deg, {self.altitude * 1e-3:.3f} m AMSL"

    def agrees(self, other: Origin) -> bool:
        """Return whether both are one place, to a centimetre."""
        return (
            abs(self.latitude - other.latitude) <= _MOST_DEGREES
            and abs(self.longitude - other.longitude) <= _MOST_DEGREES
            and abs(self.altitude - other.altitude) <= _MOST_HEIGHT
        )


def parse_origin(value: Any) -> Origin | None:
    """Return what ``/xtdrone/shared_origin`` says, None if it is empty.

    Raises:
        ValueError: it is not a place.
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
    """Asks where the autopilot's local frame begins, and sets its origin until it is the shared one.

    PX4 says nothing before it has a position. It answers SET_GPS_GLOBAL_ORIGIN at once, before its estimator has acted,
    so the answer to a try may still be the old origin; some versions do not act at all in the air (PX4's
    mavlink_receiver.cpp and EKF2.cpp). From the first answer on until the frames agree, or all tries have failed, the
    vehicle is not armed through this layer.
    """

    name = "shared_origin"

    def __init__(self, uas: Uas) -> None:
        """Wait for the autopilot."""
        super().__init__(uas)
        self._wanted: Origin | None = None
        self._heard: Origin | None = None
        self._tries = 0
        self._feed = Feed(self._on_origin)
        self.messages = {"GPS_GLOBAL_ORIGIN": self._feed}
        uas.timer(PERIOD, self._look)

    def connected(self, connected: bool) -> None:
        """Begin with an autopilot that is new, or has been rebooted."""
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
                self.uas.arming_held = f"its local frame begins at {self._heard}, and is to begin at {self._wanted}"
            return
        self._tries = 0
        self.uas.arming_held = ""
        if before is None or not self._wanted.agrees(before):
            log.info("%s: the local frame begins at the shared origin, %s", self.uas.name, self._wanted)

    def _look(self) -> None:
        """Ask, or set, once a period."""
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
        """Set the origin; after the last try has failed, say so once and let the vehicle go."""
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
