"""Calibrations of sensors: the texts of PX4 v1.14 (src/modules/commander/*_calibration.cpp) and their durations."""

from __future__ import annotations

import math

import pytest
from service_fakes import Served

from xtdrone_common.geodesy.projection import GRAVITY

GYRO, MAG, BARO, ACCEL, LEVEL, AIRSPEED = (1,), (0, 1), (0, 0, 1), (0, 0, 0, 0, 1), (0, 0, 0, 0, 2), (0, 0, 0, 0, 0, 2)
QUICK_ACCEL = (0, 0, 0, 0, 4)
ACCEPTED, TEMPORARILY_REJECTED, DENIED = 0, 1, 2
SIDES = {
    "back": (GRAVITY, 0.0, 0.0),
    "front": (-GRAVITY, 0.0, 0.0),
    "left": (0.0, GRAVITY, 0.0),
    "right": (0.0, -GRAVITY, 0.0),
    "up": (0.0, 0.0, GRAVITY),
    "down": (0.0, 0.0, -GRAVITY),
}


class Standing(Served):
    """A vehicle that stands, and the texts since the last ``calibrate``."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []
        self.autopilot.sensors["accel"] = SIDES["down"]

    def calibrate(self, *params: float) -> int | None:
        result, self.told = self.command(241, *params)
        self.commander.texts.clear()
        return result

    def tick(self) -> None:
        """Advance 0.1 s."""
        self.autopilot.time_us += 100_000
        self.commander.update()
        self.told += [text.rstrip("\t") for _, text in self.commander.texts]
        self.commander.texts.clear()

    def finish(self, limit: float = 200.0) -> float:
        """Run to the end of the calibration; return the seconds."""
        start_us = self.autopilot.time_us
        while self.commander.calibration.running:
            self.tick()
            assert self.autopilot.time_us - start_us < limit * 1e6
        return (self.autopilot.time_us - start_us) * 1e-6


@pytest.fixture
def standing():
    return Standing()


def progress(*percents):
    return [f"[cal] progress <{percent}>" for percent in percents]


@pytest.mark.parametrize(
    ("params", "seconds", "texts"),
    [
        # gyro_calibration.cpp: 250 samples at 250 Hz, every 10 %; PX4 repeats a text for samples of the same percent
        (GYRO, 1.0, ["[cal] calibration started: 2 gyro", *progress(*range(0, 101, 10)),
                     "[cal] calibration done: gyro"]),
        # level_calibration.cpp: 500 ms, every 20 %
        (LEVEL, 0.5, ["[cal] calibration started: 2 level", *progress(0, 20, 40, 60, 80, 100),
                      "[cal] calibration done: level"]),
        # baro_calibration.cpp: 3 s without progress
        (BARO, 3.0, ["[cal] calibration started: 2 baro", "[cal] calibration done: baro"]),
        # airspeed_calibration.cpp: 30 s without a sample, and 5 s for the text
        (AIRSPEED, 35.0, ["[cal] calibration started: 2 airspeed", "[cal] Ensure sensor is not measuring wind",
                          "[cal] calibration failed: airspeed"]),
    ],
)  # fmt: skip
def test_calibrations_of_a_standing_vehicle(standing, params, seconds, texts):
    assert standing.calibrate(*params) == ACCEPTED
    assert standing.finish() == pytest.approx(seconds, abs=0.15)
    assert standing.told == texts
    assert standing.calibrate(*params) == ACCEPTED, "again"


def test_the_quick_accelerometer_is_calibrated_at_once(standing):
    assert standing.calibrate(*QUICK_ACCEL) == ACCEPTED
    assert not standing.commander.calibration.running


def test_the_barometer_needs_gps(standing):
    standing.autopilot.sensors["gps_fix"] = 0
    standing.calibrate(*BARO)
    standing.finish()
    assert standing.told[1:] == ["[cal] calibration failed: GPS required for baro cal"]


def test_a_moving_gyroscope_is_measured_again(standing):
    standing.calibrate(*GYRO)
    standing.autopilot.sensors["gyro"][0] = (0.0, 0.2, 0.0)
    standing.tick()
    standing.autopilot.sensors["gyro"][0] = 0.0
    assert standing.finish() == pytest.approx(1.9)
    assert standing.told.count("motion, retrying..") == 1
    assert standing.told[-1] == "[cal] calibration done: gyro"


def test_a_gyroscope_without_samples_fails(standing):
    standing.autopilot.sensors["imu_missing"] = 1
    standing.calibrate(*GYRO)
    assert standing.finish() == pytest.approx(100.0)
    assert standing.told[-2:] == ["[cal] calibration failed: reading sensor", "[cal] calibration failed: gyro"]


def test_a_tilted_vehicle_is_not_level(standing):
    standing.autopilot.estimator["q"][0] = (math.cos(0.5), math.sin(0.5), 0.0, 0.0)
    standing.calibrate(*LEVEL)
    standing.finish()
    assert standing.told[-2:] == ["excess roll angle", "[cal] calibration failed: level"]


def test_an_accelerometer_that_is_not_turned_times_out(standing):
    """accelerometer_calibration.cpp and calibration_routines.cpp: the lower side is measured, then found five times."""
    assert standing.calibrate(*ACCEL) == ACCEPTED
    assert standing.finish() < 60.0
    rest = "[cal] detected rest position, hold still..."
    hold = "[cal] hold vehicle still on a pending side"
    again = ["[cal] pending: back front left right up", hold, rest, "[cal] down side already completed"]
    assert standing.told == [
        "[cal] calibration started: 2 accel",
        "[cal] pending: back front left right up down",
        hold,
        rest,
        *["[cal] down orientation detected"] * 2,
        "[cal] Hold still, measuring down side",
        "[cal] down side result: [0.000 0.000 -9.807]",
        *progress(17),
        *["[cal] down side done, rotate to a different side"] * 2,
        *again * 5,
        "[cal] calibration failed: timeout: no motion",
        "[cal] calibration failed: accel",
    ]


def test_a_magnetometer_that_is_not_turned_fails(standing):
    """mag_calibration.cpp: five times 7 s for the rotation, and 7 s of samples."""
    assert standing.calibrate(*MAG) == ACCEPTED
    assert 42.0 < standing.finish() < 48.0
    assert standing.told[-3:] == [
        "[cal] Rotate vehicle",
        "Failed: This calibration requires rotation.",
        "[cal] calibration failed: mag",
    ]


@pytest.mark.parametrize(
    ("params", "last", "done"),
    [(ACCEL, 102, "[cal] calibration done: accel"), (MAG, 100, "[cal] calibration done: mag")],
)
def test_a_vehicle_turned_to_six_sides(standing, params, last, done):
    standing.calibrate(*params)
    for force in SIDES.values():
        standing.autopilot.sensors["accel"][0] = force
        finished = sum("rotate to a different side" in text for text in standing.told)
        while sum("rotate to a different side" in text for text in standing.told) < finished + (
            2 if params == ACCEL else 3
        ):
            standing.autopilot.sensors["gyro"][0] = (0.0, 0.0, 0.2 if params == MAG else 0.0)
            standing.tick()
    standing.finish()
    assert progress(last)[0] in standing.told
    assert standing.told[-1] == done


@pytest.mark.parametrize(
    ("params", "texts"),
    [
        (GYRO, ["[cal] calibration cancelled", "[cal] calibration failed: gyro"]),
        (ACCEL, ["[cal] calibration cancelled", "[cal] calibration failed: accel"]),
        (MAG, ["[cal] calibration cancelled"]),
        (AIRSPEED, ["[cal] calibration cancelled"]),
    ],
)
def test_cancel(standing, params, texts):
    """calibration_routines.cpp, calibrate_cancel_check; the texts after it differ between the sensors."""
    standing.calibrate(*params)
    standing.tick()
    assert standing.calibrate(*MAG) == DENIED
    assert standing.told == ["command denied during calibration: 241"]
    assert standing.calibrate() == ACCEPTED
    assert standing.told == texts
    standing.tick()
    assert standing.told == texts
    assert standing.calibrate(*GYRO) == ACCEPTED


@pytest.mark.parametrize("params", [LEVEL, BARO])
def test_short_calibrations_cannot_be_cancelled(standing, params):
    standing.calibrate(*params)
    assert standing.calibrate() == TEMPORARILY_REJECTED
    assert standing.commander.calibration.running


def test_a_vehicle_in_calibration_is_not_armed(standing):
    standing.calibrate(*GYRO)
    assert standing.commander.system_status == 2, "MAV_STATE_CALIBRATING"
    assert not standing.commander.ready_to_arm
    assert standing.command(400, 1) == (TEMPORARILY_REJECTED, ["Transition denied: Init to Armed"])
    assert standing.command(400, 1, 21196)[0] == TEMPORARILY_REJECTED
    assert standing.command(245, 1)[0] == standing.command(42006)[0] == TEMPORARILY_REJECTED
    standing.finish()
    assert standing.commander.system_status == 3
    assert standing.command(42006)[0] == ACCEPTED
    assert standing.command(400, 1)[0] == ACCEPTED


@pytest.mark.parametrize("params", [(), GYRO, MAG, BARO, ACCEL, LEVEL, QUICK_ACCEL, AIRSPEED])
def test_armed_vehicles_are_not_calibrated(standing, params):
    standing.commander.armed = True
    assert standing.calibrate(*params) == TEMPORARILY_REJECTED
    assert standing.told == []
