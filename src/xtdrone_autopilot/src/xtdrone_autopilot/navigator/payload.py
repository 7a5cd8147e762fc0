"""Payload commands: camera trigger, gimbal setpoint and actuator outputs, stored for the devices.

A simulated device or the driver of a real one reads ``gimbal`` and ``actuators`` and registers ``on_camera_trigger``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.gimbal_manager import GimbalManager
from xtdrone_autopilot.vehicle_view import Vector, VehicleView

_MAX_WAITING = 64
_NEVER_US = 1 << 62
_ACTUATORS = 6
_SHOTS_UNLIMITED = -1


@dataclass(frozen=True)
class Shot:
    """Camera trigger.

    Attributes:
        number: sequence number, from 1.
        time_us: simulated time, microseconds.
        position: position of the vehicle, m, local NED.
    """

    number: int
    time_us: int
    position: Vector


class Payload:
    """Camera trigger, gimbal setpoint and actuators of one vehicle.

    Attributes:
        gimbal_manager: gimbal setpoint and its control authority.
        gimbal_attitude: measured attitude written by the simulator or a driver: roll and pitch from the horizon, yaw
            from the heading, rad; None without a gimbal.
        actuators: outputs of DO_SET_ACTUATOR, -1..1, NaN until set.
        recording: whether video recording is on.
        on_camera_trigger: called with every shot; None without a camera.
        shots: shots not yet reported by a link; beyond 64 the oldest are dropped.
        count: number of shots so far.
    """

    def __init__(self, view: VehicleView) -> None:
        """Start with the camera off."""
        self._view = view
        self.gimbal_manager = GimbalManager(view)
        self.gimbal_attitude: Vector | None = None
        self.actuators = [math.nan] * _ACTUATORS
        self.recording = False
        self.on_camera_trigger: Callable[[Shot], None] | None = None
        self.shots: deque[Shot] = deque(maxlen=_MAX_WAITING)
        self.count = 0
        self._distance = 0.0
        self._last_position: Vector | None = None
        self._interval_us = 0
        self._next_us = _NEVER_US
        self._shots_left = _SHOTS_UNLIMITED
        self._paused = False
        self._capturing = False  # pictures of START_IMAGES, which end with the mission; the trigger's only pause

    @property
    def gimbal(self) -> Vector:
        """Setpoint of roll, pitch and yaw, rad: pitch positive up, yaw from the heading; NaN: not controlled."""
        return self.gimbal_manager.angles

    def execute(self, command: int, params: Sequence[float]) -> bool:
        """Execute a payload command.

        Args:
            command: MAV_CMD.
            params: parameters 1 to 7; non-finite values count as 0.

        Returns:
            Whether the command is a payload command.
        """
        handler = _HANDLERS.get(command)
        if handler is None:
            return False
        handler(self, [p if math.isfinite(p) else 0.0 for p in params])
        return True

    def pause(self, paused: bool) -> None:
        """Suspend or resume camera triggering."""
        self._paused = paused

    def stop_with_mission(self) -> None:
        """Suspend camera triggering and end a series of pictures (PX4 ``Mission::on_inactivation``)."""
        self.pause(True)
        if self._capturing:
            self._stop_images(())

    def update(self) -> None:
        """Trigger the camera when a shot is due; call at about 10 Hz."""
        if self._paused:
            return
        if self._distance > 0.0 and self._distance_reached():
            self._trigger()
        if self._view.time_us >= self._next_us:
            self._trigger()
            self._next_us += self._interval_us
            self._shots_left -= self._shots_left > 0
            if self._shots_left == 0:
                self._next_us = _NEVER_US

    def _distance_reached(self) -> bool:
        if self._last_position is None:
            return True
        x, y, _ = self._view.position
        return math.hypot(x - self._last_position[0], y - self._last_position[1]) >= self._distance

    def _trigger(self) -> None:
        self.count += 1
        self._last_position = self._view.position
        shot = Shot(self.count, self._view.time_us, self._last_position)
        self.shots.append(shot)
        if self.on_camera_trigger is not None:
            self.on_camera_trigger(shot)

    # commands

    def _set_distance(self, p: Sequence[float]) -> None:
        self._distance = max(p[0], 0.0)
        self._last_position = self._view.position
        if p[2] == 1.0:
            self._trigger()

    def _repeat(self, interval: float, shots: int) -> None:
        self._interval_us = max(round(interval * 1e6), 1)
        self._shots_left = shots
        self._next_us = self._view.time_us

    def _set_interval(self, p: Sequence[float]) -> None:
        self._capturing = False
        if p[0] > 0.0:
            self._repeat(p[0] * 1e-3, _SHOTS_UNLIMITED)
        elif p[0] == 0.0:
            self._next_us = _NEVER_US

    def _start_images(self, p: Sequence[float]) -> None:
        if p[2] == 1.0 or p[1] <= 0.0:
            self._trigger()
        else:
            self._repeat(p[1], round(p[2]) if p[2] > 0.0 else _SHOTS_UNLIMITED)
            self._capturing = True

    def _stop_images(self, _p: Sequence[float]) -> None:
        self._next_us = _NEVER_US
        self._distance = 0.0
        self._capturing = False

    def _digicam(self, p: Sequence[float]) -> None:
        if p[4] == 1.0:
            self._trigger()

    def _trigger_control(self, p: Sequence[float]) -> None:
        if p[2] in (0.0, 1.0):
            self._paused = p[2] == 1.0
        if p[0] == 0.0:
            self._next_us = _NEVER_US
            self._distance = 0.0

    def _mount(self, p: Sequence[float]) -> None:
        self.gimbal_manager.mount(p)

    def _pitch_yaw(self, p: Sequence[float]) -> None:
        self.gimbal_manager.pitch_yaw(p)

    def _set_actuators(self, p: Sequence[float]) -> None:
        if p[6] == 0.0:
            self.actuators = [min(max(value, -1.0), 1.0) for value in p[:_ACTUATORS]]

    def _record(self, recording: bool) -> None:
        self.recording = recording

    def _ignore(self, _p: Sequence[float]) -> None:
        """Accept a command without an effect here, for example camera zoom."""


_HANDLERS: dict[int, Callable[[Payload, Sequence[float]], None]] = {
    plan.TRIGGER_DISTANCE: Payload._set_distance,
    plan.TRIGGER_INTERVAL: Payload._set_interval,
    plan.TRIGGER_CONTROL: Payload._trigger_control,
    plan.START_IMAGES: Payload._start_images,
    plan.STOP_IMAGES: Payload._stop_images,
    plan.DIGICAM_CONTROL: Payload._digicam,
    plan.MOUNT_CONTROL: Payload._mount,
    plan.GIMBAL_PITCHYAW: Payload._pitch_yaw,
    plan.SET_ACTUATOR: Payload._set_actuators,
    plan.START_VIDEO: lambda payload, _: payload._record(True),
    plan.STOP_VIDEO: lambda payload, _: payload._record(False),
    **dict.fromkeys((plan.CONTROL_VIDEO, plan.MOUNT_CONFIGURE, plan.GIMBAL_CONFIGURE), Payload._ignore),
    **dict.fromkeys((plan.OBLIQUE_SURVEY, plan.CAMERA_MODE, plan.CAMERA_ZOOM, plan.CAMERA_FOCUS), Payload._ignore),
    **dict.fromkeys((plan.GRIPPER, plan.WINCH), Payload._ignore),
}
