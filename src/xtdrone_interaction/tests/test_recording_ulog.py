"""Reports of flight logs: figures in closed form, and incomplete logs."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest

from xtdrone_autopilot.logger.message_definitions import message_format
from xtdrone_autopilot.logger.ulog_format import UlogWriter, data_template, logged_string
from xtdrone_interaction import cli
from xtdrone_interaction.metrics.setpoint_tracking import tracking, trackings
from xtdrone_interaction.metrics.spectrum import (
    spectrum,
)
from xtdrone_interaction.metrics.vehicle_metrics import summarise_log
from xtdrone_interaction.recording.flight_from_ulog import LogError, euler, read_log
from xtdrone_interaction.recording.open_recording import log_recording
from xtdrone_interaction.recording.series_in_bounded_memory import Series

SECONDS, RATE = 20.0, 250.0
PITCHING, LATE, AMPLITUDE = 3.0, 0.048, 0.4  # Hz, s, rad/s
SHAKING = 40.0  # Hz
START_US = 5_000_000
LOST = 0.5  # s; until then the estimator has no position


def block(topic: str, number: int, time: np.ndarray, **values: object) -> bytes:
    """Return all messages of a topic, concatenated."""
    template = data_template(message_format(topic), number)
    rows = np.repeat(template[None], len(time))
    rows["record"]["timestamp"] = START_US + np.round(1e6 * time).astype(np.uint64)
    for name, value in values.items():
        rows["record"][name] = value
    return rows.tobytes()


def make_log() -> bytes:
    """Return a log: armed from 1 s to 19 s, up to 6 m; pitch rates lag; a vibration along z."""
    time = np.arange(0.0, SECONDS, 1 / RATE)
    slow, status = time[::25], np.array([0.0, 1.0, 2.0, 19.0, SECONDS])
    angle = 2 * np.pi * PITCHING * time
    rates = np.stack([0 * time, AMPLITUDE * np.sin(angle - 2 * np.pi * PITCHING * LATE), 0 * time], axis=1)
    acceleration = np.stack([0 * time, 0 * time, -9.81 + 2.0 * np.sin(2 * np.pi * SHAKING * time)], axis=1)
    height = np.interp(slow, [2.0, 8.0, 12.0, 18.0], [0.0, 6.0, 6.0, 0.0])
    climb = np.select([(slow >= 2) & (slow < 8), (slow > 12) & (slow <= 18)], [1.0, -1.0], 0.0)
    states = {"nav_state": np.array([4, 4, 14, 18, 18]), "arming_state": np.array([1, 2, 2, 1, 1])}
    place = {"x": 3.0 * slow, "z": -height, "vx": 3.0, "vz": -climb}
    place |= {name: slow >= LOST for name in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid")}
    blocks: dict[str, dict[str, object]] = {
        "vehicle_status": {"time": status, **states},
        "vehicle_local_position": {"time": slow, **place},
        "vehicle_local_position_setpoint": {"time": slow, "x": 3.0 * slow + 0.25, "z": np.nan, "vx": 3.5, "vz": np.nan},
        "mission_result": {"time": np.array([5000.0])},  # stored earlier; its time belongs to nothing in this log
        "manual_control_setpoint": {"time": np.array([-4.0, -3.0, 5.0]), "roll": np.array([0.1, 0.2, 0.3])},
        "vehicle_rates_setpoint": {"time": time, "pitch": AMPLITUDE * np.sin(angle)},
        "vehicle_angular_velocity": {"time": time, "xyz": rates},
        "sensor_combined": {"time": time, "accelerometer_m_s2": acceleration, "gyro_rad": rates},
    }
    sink = io.BytesIO()
    writer = UlogWriter(sink, START_US)
    writer.add_info("char", "sys_name", "PX4")
    writer.add_info("uint32_t", "ver_sw_release", 0x010E03C0)
    writer.add_parameter("MPC_XY_P", 1.5)
    writer.add_default_parameter("MPC_XY_P", 0.95, 1)
    for topic in blocks:
        writer.add_format(message_format(topic))
    for number, topic in enumerate(blocks):
        writer.subscribe(number, message_format(topic))
    writer.add_messages(logged_string(4, START_US + 1_500_000, "\x1b[31mSomething odd\x1b[0m\t"))
    for number, (topic, values) in enumerate(blocks.items()):
        writer.add_messages(block(topic, number, **values))  # type: ignore[arg-type]
    writer.flush()
    return sink.getvalue()


@pytest.fixture(scope="module")
def data() -> bytes:
    return make_log()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def test_figures_are_those_of_the_motion(tmp_path: Path, data: bytes) -> None:
    log = read_log(write(tmp_path / "log.ulg", data))
    assert log.notes == []
    figures = summarise_log(log_recording(log), log)
    assert figures["armed_time"] == pytest.approx(18.0)
    assert figures["modes"] == pytest.approx({"AUTO.LOITER": 2.0, "OFFBOARD": 17.0, "AUTO.LAND": 1.0}, abs=0.01)
    assert figures["highest"] == pytest.approx(6.0, abs=0.02)
    assert figures["greatest_speed"] == pytest.approx(3.0)
    assert figures["way"] == pytest.approx(2 * np.hypot(18.0, 6.0) + 6 * 3.0, rel=0.02)
    assert log.changed == [("MPC_XY_P", 1.5, pytest.approx(0.95))]
    assert log.texts == [(1.5, "WARNING", "Something odd")]
    rows = {(what, found.name): found for what, found in trackings(log)}
    pitch = rows["Rates", "pitch [°/s]"]
    error = 2 * np.degrees(AMPLITUDE) * np.sin(np.pi * PITCHING * LATE)
    assert pitch.delay == pytest.approx(LATE, abs=1.5 / RATE)
    assert pitch.rms == pytest.approx(error / np.sqrt(2), rel=0.03)
    assert pitch.greatest == pytest.approx(error, rel=0.03)
    assert rows["Position", "north [m]"].rms == pytest.approx(0.25, abs=1e-4)
    assert rows["Velocity", "north [m/s]"].greatest == pytest.approx(0.5)
    assert ("Position", "up [m]") not in rows  # the estimator has received no height


def test_values_missing_in_the_log_are_not_shown(tmp_path: Path, data: bytes) -> None:
    """Hidden are positions before the first estimate, a message of another time base, sticks from before the log."""
    log = read_log(write(tmp_path / "log.ulg", data))
    assert log.duration == pytest.approx(SECONDS)
    place = log.series("vehicle_local_position", "x", "z", "vx", "vz")
    assert place is not None
    np.testing.assert_array_equal(np.isfinite(place.value).all(axis=1), place.time >= LOST)
    sticks = log.series("manual_control_setpoint", "roll")
    assert sticks is not None
    np.testing.assert_allclose(np.column_stack([sticks.time, sticks.value]), [[0.0, 0.2], [5.0, 0.3]], atol=1e-6)
    assert log.info["release"] == "v1.14.3 (release candidate)"


def test_data_appended_after_a_crash_are_read(tmp_path: Path, data: bytes) -> None:
    """PX4 appends the data saved in a crash at an offset stated in the flags, after a truncated message."""
    text = logged_string(4, START_US + 19_000_000, "hard fault")
    bad = bytearray(data[:-5])
    flags = 16 + 3
    assert bad[18:19] == b"B"
    bad[flags + 8] |= 1
    bad[flags + 16 : flags + 24] = len(bad).to_bytes(8, "little")
    log = read_log(write(tmp_path / "log.ulg", bytes(bad) + text))
    assert log.notes == []
    assert log.texts[-1] == (19.0, "WARNING", "hard fault")
    assert read_log(write(tmp_path / "log.ulg", bytes(bad) + text[:-1])).cut


def test_a_response_that_does_not_follow_has_no_delay() -> None:
    time = np.arange(0.0, 20.0, 0.01)
    told, noise = np.sin(2 * time), np.random.default_rng(0).standard_normal(len(time))
    wanted = Series(time, told[:, None])
    late = tracking("late", wanted, Series(time, np.sin(2 * (time - 0.3))[:, None] + 0.2 * noise[:, None]), 0.0, 20.0)
    assert late is not None
    assert late.delay == pytest.approx(0.3, abs=0.03)
    lost = tracking("lost", wanted, Series(time, noise[:, None]), 0.0, 20.0)
    assert lost is not None
    assert lost.delay is None


def test_the_spectrum_has_the_vibration_with_its_power(tmp_path: Path, data: bytes) -> None:
    log = read_log(write(tmp_path / "log.ulg", data))
    series = log.array("sensor_combined", "accelerometer_m_s2", 3)
    assert series is not None
    found = spectrum(series, *log.flown)
    assert found is not None
    frequency, density = found
    assert frequency[density[:, 2].argmax()] == pytest.approx(SHAKING, abs=frequency[1])
    power = np.trapz(density[:, 2], frequency)
    assert power == pytest.approx(2.0**2 / 2, rel=0.5)  # the median's bias is that of noise, not of a tone


def test_angles_are_those_of_the_quaternion() -> None:
    half = np.radians(30.0) / 2
    turns = np.array([[np.cos(half), *(np.sin(half) * axis)] for axis in np.eye(3)])
    np.testing.assert_allclose(euler(turns), 30.0 * np.eye(3), atol=1e-9)


def test_a_log_cut_off_anywhere_gives_its_beginning(tmp_path: Path, data: bytes) -> None:
    whole = read_log(write(tmp_path / "log.ulg", data))
    first = data.index(b"sys_name")
    cuts = np.random.default_rng(1).integers(first, len(data), 12).tolist()
    for cut in [*cuts, len(data) - 1, len(data) - 100]:
        log = read_log(write(tmp_path / "cut.ulg", data[:cut]))
        assert log.notes or len(data[:cut]) == len(data), cut
        for key, (time, fields) in log.topics.items():
            assert np.array_equal(time, whole.topics[key][0][: len(time)])
            for name, values in fields.items():
                assert np.array_equal(values, whole.topics[key][1][name][: len(values)], equal_nan=True)
    for cut in (8, 15):
        with pytest.raises(LogError):
            read_log(write(tmp_path / "cut.ulg", data[:cut]))


def test_damage_is_reported_and_the_data_before_it_is_shown(tmp_path: Path, data: bytes) -> None:
    rng = np.random.default_rng(2)
    for _ in range(8):
        bad = bytearray(data)
        at = int(rng.integers(len(data) // 2, len(data) - 400))
        bad[at : at + 300] = rng.integers(0, 256, 300, np.uint8).tobytes()
        log = read_log(write(tmp_path / "bad.ulg", bytes(bad)))
        assert log.notes
        assert len(log.topics["vehicle_local_position", 0][0]) == 200


def test_the_report_is_one_page(tmp_path: Path, data: bytes) -> None:
    path = write(tmp_path / "log.ulg", data[:-1000])
    assert cli.main(["analyse", str(path), "--out", str(tmp_path / "out")]) == 0
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert figures["cut_off"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "is cut off at byte" in page
    assert "Something odd" in page
    names = {picture.stem for picture in (tmp_path / "out").glob("*.png")}
    assert {"track", "position", "velocity", "rates", "imu", "spectra", "spectrogram_acceleration"} <= names


def test_files_other_than_logs_are_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["analyse", str(write(tmp_path / "log.ulg", b"#ROSBAG V2.0\n"))]) == 1
    assert "is no ULog" in capfd.readouterr().err
