"""Calibration of a disarmed vehicle's sensors, with the texts and durations of PX4 v1.14's commander.

Ground stations and MAVSDK follow the texts. The sensors are measured while the calibration runs, but the simulated
sensors need no calibration, so no CAL_* or SENS_BOARD_* parameter changes. Sources: ``gyro_calibration.cpp``,
``accelerometer_calibration.cpp``, ``mag_calibration.cpp``, ``level_calibration.cpp``, ``baro_calibration.cpp``,
``airspeed_calibration.cpp`` and ``calibration_routines.cpp``.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Generator

from xtdrone_autopilot.commander.flight_commands import Result
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.announcements import CRITICAL, INFO, Announcements
from xtdrone_autopilot.vehicle_view import VehicleView
from xtdrone_common import rotation
from xtdrone_common.geodesy.projection import GRAVITY

Steps = Generator[None, None, bool]  # one step per call of the commander; returns whether the calibration succeeded

_COMMAND = 241  # MAV_CMD_PREFLIGHT_CALIBRATION
_STEP = 0.1  # s between two calls of update
_FAIL_WHEN_CANCELLED = ("gyro", "accel")  # their cancellation is followed by the text of a failure
_CANCELLABLE = (*_FAIL_WHEN_CANCELLED, "mag", "airspeed")
_NO_SAMPLE_STEPS = 1000  # of 0.1 s, PX4's wait for one sample
_GYRO_SAMPLES, _GYRO_MEDIAN, _GYRO_TRIES = 10, 9, 21  # 1 s, as 250 samples of PX4's simulated gyroscope
_GYRO_LIMIT = math.radians(0.6)  # rad/s between mean and median
_LEVEL_US, _LEVEL_TRIES = 500_000, 50
_LEVEL_MOTION, _LEVEL_LIMIT = math.radians(0.5), 0.8  # rad
_BARO_STEPS = 30
_FIX_2D = 2
_FAILURES = {"baro": "GPS required for baro cal"}  # other texts name the sensor
_AIRSPEED_US, _AIRSPEED_PAUSE_US = 30_000_000, 5_000_000
_SIDES = {  # PX4's name of the side that points down, to the specific force in m/s^2, body FRD
    "back": (GRAVITY, 0.0, 0.0),
    "front": (-GRAVITY, 0.0, 0.0),
    "left": (0.0, GRAVITY, 0.0),
    "right": (0.0, -GRAVITY, 0.0),
    "up": (0.0, 0.0, GRAVITY),
    "down": (0.0, 0.0, -GRAVITY),
}
_SIDE_TOLERANCE = 5.0  # m/s^2
_SIDE_FAILURES = 4
_STILL, _LENIENT_STILL = 0.25, 0.75  # m/s^2
_STILL_US, _LENIENT_STILL_US = 1_300_000, 500_000
_STILL_WEIGHT = _STEP / 0.5  # of a sample in the moving average
_STILL_TIMEOUT_US = 90_000_000
_ACCEL_SAMPLES = 30  # 3 s, as 750 samples of PX4's simulated accelerometer
_MAG_SIDE_US = 7_000_000  # 42 s for six sides
_MAG_ROTATION_US = 5 * _MAG_SIDE_US
_MAG_ANGLE = 0.5  # rad


class SensorCalibration:
    """The calibration that runs, at most one at a time."""

    def __init__(self, view: VehicleView, announcements: Announcements) -> None:
        """Calibrate the sensors of the vehicle ``view``; texts go to ``announcements``."""
        self._view = view
        self._announcements = announcements
        self._sensor = ""
        self._steps: Steps | None = None
        self._routines: dict[str, Callable[[], Steps]] = {
            "gyro": self._calibrate_gyro,
            "mag": self._calibrate_mag,
            "baro": self._calibrate_baro,
            "accel": self._calibrate_accel,
            "level": self._calibrate_level,
            "airspeed": self._calibrate_airspeed,
        }

    @property
    def running(self) -> bool:
        """Whether a calibration runs."""
        return self._steps is not None

    def start(self, sensor: str) -> None:
        """Start a calibration: gyro, mag, baro, accel, level or airspeed."""
        self._sensor = sensor
        self._say(f"[cal] calibration started: 2 {sensor}")
        self._steps = self._routines[sensor]()
        self.update()

    def answer(self, *, cancels: bool) -> Result:
        """Answer a command of calibration received while one runs (``calibrate_cancel_check``).

        Args:
            cancels: the command asks for no calibration, which cancels the running one if it is of those that can be.
        """
        if self._sensor not in _CANCELLABLE:
            return Result.TEMPORARILY_REJECTED
        if not cancels:
            text = f"command denied during calibration: {_COMMAND}"
            self._announcements.tell(CRITICAL, text, "commander_cal_cmd_denied", _COMMAND, level=events.ERROR)
            return Result.DENIED
        self._steps = None
        self._fail("[cal] calibration cancelled")
        if self._sensor in _FAIL_WHEN_CANCELLED:
            self._fail(f"[cal] calibration failed: {self._sensor}")
        return Result.ACCEPTED

    def update(self) -> None:
        """Continue the calibration; call every 0.1 s of simulated time."""
        if self._steps is None:
            return
        try:
            next(self._steps)
        except StopIteration as end:
            self._steps = None
            if end.value:
                self._say(f"[cal] calibration done: {self._sensor}")
            else:
                self._fail(f"[cal] calibration failed: {_FAILURES.get(self._sensor, self._sensor)}")

    def _say(self, text: str) -> None:
        self._announcements.say(INFO, text)

    def _fail(self, text: str) -> None:
        self._announcements.say(CRITICAL, text)

    def _report(self, percent: int) -> None:
        self._say(f"[cal] progress <{percent}>")

    def _wait(self, duration_us: int) -> Generator[None, None, None]:
        end_us = self._view.time_us + duration_us
        while self._view.time_us < end_us:
            yield

    def _sample(self, field: str) -> Generator[None, None, list[float] | None]:
        """Return the next sample of ``gyro`` (rad/s) or ``accel`` (m/s^2), body FRD; None when none comes."""
        for _ in range(_NO_SAMPLE_STEPS):
            yield
            if not self._view.sensors["imu_missing"]:
                values: list[float] = self._view.sensors[field].tolist()
                return values
        self._fail("[cal] calibration failed: reading sensor")
        return None

    def _calibrate_gyro(self) -> Steps:
        """Measure the gyroscope for a second, again while the vehicle moves."""
        self._report(0)
        for _ in range(_GYRO_TRIES):
            samples: list[list[float]] = []
            while len(samples) < _GYRO_SAMPLES:
                sample = yield from self._sample("gyro")
                if sample is None:
                    return False
                samples.append(sample)
                self._report(100 * len(samples) // _GYRO_SAMPLES)
            axes = list(zip(*samples, strict=True))
            if all(abs(statistics.median(a[-_GYRO_MEDIAN:]) - statistics.fmean(a)) <= _GYRO_LIMIT for a in axes):
                return True
            self._fail("motion, retrying..")
        self._fail("ERROR: Motion during calibration")
        return False

    def _calibrate_baro(self) -> Steps:
        """Compare the barometer with GPS for 3 s."""
        fixed = False
        for _ in range(_BARO_STEPS):
            fixed = fixed or self._view.sensors["gps_fix"] >= _FIX_2D
            yield
        return fixed

    def _calibrate_level(self) -> Steps:
        """Measure roll and pitch for half a second, again while the vehicle moves."""
        yield  # the commander's steps divide the half second evenly only from the next one on
        for _ in range(_LEVEL_TRIES):
            rolls, pitches = yield from self._measure_tilt()
            moved = max(max(angles) - min(angles) for angles in (rolls, pitches)) >= _LEVEL_MOTION
            if not moved:
                break
        self._report(100)
        for excess, text in (
            (moved, "motion during calibration"),
            (abs(statistics.fmean(rolls)) > _LEVEL_LIMIT, "excess roll angle"),
            (abs(statistics.fmean(pitches)) > _LEVEL_LIMIT, "excess pitch angle"),
        ):
            if excess:
                self._fail(text)
                return False
        return True

    def _measure_tilt(self) -> Generator[None, None, tuple[list[float], list[float]]]:
        rolls: list[float] = []
        pitches: list[float] = []
        start_us = self._view.time_us
        while (elapsed_us := self._view.time_us - start_us) < _LEVEL_US:
            self._report(100 * elapsed_us // _LEVEL_US)
            roll, pitch, _ = rotation.to_euler(self._view.estimator["q"].tolist())
            rolls.append(roll)
            pitches.append(pitch)
            yield
        return rolls, pitches

    def _calibrate_airspeed(self) -> Steps:
        """Wait for a sensor of airspeed, which the vehicles do not have."""
        self._fail("[cal] Ensure sensor is not measuring wind")
        yield from self._wait(_AIRSPEED_US + _AIRSPEED_PAUSE_US)
        return False

    # on six sides; a vehicle that stands still fails

    def _calibrate_accel(self) -> Steps:
        """Measure the accelerometer on six sides."""
        return (yield from self._measure_sides(self._measure_accel, _STILL, _STILL_US))

    def _calibrate_mag(self) -> Steps:
        """Measure the magnetometer while the vehicle turns on each of six sides."""
        done = yield from self._measure_sides(self._measure_mag, _LENIENT_STILL, _LENIENT_STILL_US)
        if done:
            self._report(100)
        return done

    def _measure_sides(self, measure: Callable[[str, int], Steps], threshold: float, still_us: int) -> Steps:
        """Measure every side once; see PX4's ``calibrate_from_orientation``.

        Args:
            measure: measurement of a side, given its name and the number of sides done before.
            threshold: deviation from the average, m/s^2, below which the vehicle is still.
            still_us: duration of stillness, us, after which a side is accepted.
        """
        pending = list(_SIDES)
        failures = 0
        while pending:
            if failures > _SIDE_FAILURES:
                self._fail("[cal] calibration failed: timeout: no motion")
                return False
            self._say(f"[cal] pending: {' '.join(pending)}")
            self._say("[cal] hold vehicle still on a pending side")
            side = yield from self._detect_side(threshold, still_us)
            if side not in pending:
                failures += 1
                self._say(f"[cal] {side} side already completed" if side else "[cal] detected motion, hold still...")
                continue
            failures = 0
            for _ in range(2):
                self._say(f"[cal] {side} orientation detected")
            if not (yield from measure(side, len(_SIDES) - len(pending))):
                return False
            for _ in range(2):
                self._say(f"[cal] {side} side done, rotate to a different side")
            pending.remove(side)
        return True

    def _detect_side(self, threshold: float, still_us: int) -> Generator[None, None, str]:
        """Return the side on which the vehicle rests, empty for none; see PX4's ``detect_orientation``."""
        limit = threshold**2
        mean, spread = [0.0] * 3, [0.0] * 3
        still_since: int | None = None
        end_us = self._view.time_us + _STILL_TIMEOUT_US
        while still_since is None or self._view.time_us <= still_since + still_us:
            sample = yield from self._sample("accel")
            if sample is None:
                return ""
            for i, value in enumerate(sample):
                deviation = value - mean[i]
                mean[i] += deviation * _STILL_WEIGHT
                spread[i] = max(spread[i] * (1.0 - _STILL_WEIGHT), min(deviation**2, 8.0 * limit))
            if max(spread) < limit and still_since is None:
                self._say("[cal] detected rest position, hold still...")
                still_since = self._view.time_us
                end_us = still_since + _STILL_TIMEOUT_US
            elif max(spread) > 4.0 * limit and still_since is not None:
                self._say("[cal] detected motion, hold still...")
                still_since = None
            if self._view.time_us > end_us:
                self._fail("[cal] calibration failed: reading sensor")
                return ""
        for side, force in _SIDES.items():
            if all(abs(a - b) < _SIDE_TOLERANCE for a, b in zip(mean, force, strict=True)):
                return side
        self._fail("ERROR: invalid orientation")
        return ""

    def _measure_accel(self, side: str, done: int) -> Steps:
        self._say(f"[cal] Hold still, measuring {side} side")
        samples: list[list[float]] = []
        while len(samples) < _ACCEL_SAMPLES:
            sample = yield from self._sample("accel")
            if sample is None:
                return False
            samples.append(sample)
        x, y, z = (statistics.fmean(axis) for axis in zip(*samples, strict=True))
        self._say(f"[cal] {side} side result: [{x:.3f} {y:.3f} {z:.3f}]")
        self._report(17 * (done + 1))
        return True

    def _measure_mag(self, side: str, done: int) -> Steps:
        self._say("[cal] Rotate vehicle")
        angles = [0.0] * 3
        end_us = self._view.time_us + _MAG_ROTATION_US
        turned = True
        while max(map(abs, angles)) < _MAG_ANGLE:
            if self._view.time_us > end_us:
                self._fail("Failed: This calibration requires rotation.")
                turned = False
                break
            sample = yield from self._sample("gyro")
            if sample is None:
                return False
            angles = [angle + rate * _STEP for angle, rate in zip(angles, sample, strict=True)]
        yield from self._wait(_MAG_SIDE_US)
        if turned:
            self._say(f"[cal] {side} side done, rotate to a different side")
            self._report(100 * (done + 1) // len(_SIDES))
        return turned
