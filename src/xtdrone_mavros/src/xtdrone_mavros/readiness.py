"""What keeps a vehicle from arming and from OFFBOARD, for the service ``~get_readiness`` of the MAVROS node.

A caller that also wants battery and estimator of many vehicles saves three subscriptions to each of them: for some
seconds the autopilots send both as if these topics had subscribers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink
from xtdrone_msgs.msg import FailingCheck, VehicleReadiness

from xtdrone_autopilot.events.events import ERROR
from xtdrone_common import modes
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

_WANTED_FOR = 10.0  # s of wall time after a request


class TelemetryDemand:
    """Need of battery and estimator by callers of the service; takes the place of a topic in the vehicles' feeds.

    Attributes:
        needed: whether there is one.
    """

    def __init__(self, changed: Callable[[], None], clock: Callable[[], float] = time.monotonic) -> None:
        """Begin without need.

        Args:
            changed: called when the need begins or ends, so that the vehicles' hubs refresh.
            clock: wall time, s.
        """
        self.needed = False
        self._changed = changed
        self._clock = clock
        self._end = -math.inf

    def ask(self) -> None:
        """Need the messages for some seconds from now; in any thread."""
        self._end = self._clock() + _WANTED_FOR
        if not self.needed:
            self._changed()

    def tend(self) -> None:
        """End a need that has not been renewed; called each turn."""
        if self.needed and self._clock() > self._end:
            self._changed()

    def refresh(self) -> None:
        """Update ``needed``."""
        self.needed = self._clock() <= self._end


class TelemetryPlugin(Plugin):
    """Keeps the latest battery and estimator messages while they are needed."""

    name = "readiness"
    listed = False

    def __init__(self, uas: Uas, demand: TelemetryDemand) -> None:
        """Make the vehicle's feeds depend on the demand, which all vehicles share."""
        super().__init__(uas)
        uas.share(demand)
        self.messages = {name: Feed(None, demand) for name in ("BATTERY_STATUS", "ESTIMATOR_STATUS")}


class TelemetryOf:
    """Factory of the vehicles' plugins."""

    name = TelemetryPlugin.name
    listed = TelemetryPlugin.listed

    def __init__(self, demand: TelemetryDemand) -> None:
        self._demand = demand

    def __call__(self, uas: Uas) -> TelemetryPlugin:
        """Create a vehicle's plugin."""
        return TelemetryPlugin(uas, self._demand)


def readiness(uas: Uas, *, telemetry: bool = False) -> VehicleReadiness:
    """Return the state of a vehicle and its failing checks; may be called in any thread.

    Args:
        uas: hub of the vehicle.
        telemetry: Telemetry, with battery and estimator where they have been received.
    """
    heartbeat, refusals, link = uas.heartbeat, uas.refusals, uas.link
    message = VehicleReadiness(vehicle=uas.name, connected=uas.connected, reported=refusals.reported)
    message.battery = math.nan
    message.fcu_url = f"udp://:{link.port}@{link.remote[0]}:{link.remote[1]}"
    mode = modes.from_custom_mode(refusals.custom_mode)
    if uas.connected and heartbeat is not None:
        message.armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        message.mode = mode.name if mode else ""
        message.system_status = heartbeat.system_status
    if telemetry:
        _add_telemetry(message, uas)
    if uas.arming_held:
        message.checks.append(FailingCheck(text=uas.arming_held, level=ERROR, blocks_arming=True))
    for check in refusals.failing:
        message.checks.append(
            FailingCheck(
                name=check.name,
                text=check.words,
                level=check.level,
                blocks_arming=mode is not None and check.stands_against(mode.state),
                blocks_offboard=check.stands_against(modes.OFFBOARD.state),
            )
        )
    return message


def _add_telemetry(message: VehicleReadiness, uas: Uas) -> None:
    battery, estimator = uas.glance("BATTERY_STATUS"), uas.glance("ESTIMATOR_STATUS")
    if battery is not None and battery.battery_remaining >= 0:
        message.battery = battery.battery_remaining / 100.0
    if estimator is not None:
        message.estimated, message.estimator_flags = True, estimator.flags
