"""Measurements of UWB sensors as ROS messages."""

from __future__ import annotations

from collections.abc import Sequence

from rospy import Time
from xtdrone_msgs.msg import RelativeRange, RelativeRanges

from xtdrone_sim.uwb.antennas import Antenna
from xtdrone_sim.uwb.ranging import Neighbours


def ranges_message(sensor: Antenna, others: Sequence[Antenna], time_us: int, seen: Neighbours) -> RelativeRanges:
    """Return the message of a measurement.

    Args:
        sensor: the measuring sensor.
        others: its n neighbours.
        time_us: simulated time of the measurement, microseconds.
        seen: the measurement.
    """
    message = RelativeRanges(vehicle=sensor.vehicle)
    message.header.stamp, message.header.frame_id = Time(0, time_us * 1000), sensor.frame_id
    deviations = seen.deviations(sensor.mount)
    for k, other in enumerate(others):
        if not seen.heard[k]:
            continue
        measured = RelativeRange(vehicle=other.vehicle, frame_id=other.frame_id, line_of_sight=not seen.blocked[k])
        measured.range, measured.range_std = float(seen.ranges[k]), float(deviations[k])
        if sensor.mount.bearing:
            measured.has_bearing, measured.bearing_std = True, sensor.mount.bearing_noise
            measured.azimuth, measured.elevation = float(seen.azimuths[k]), float(seen.elevations[k])
        message.ranges.append(measured)
    return message
