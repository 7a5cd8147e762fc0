"""A flight log as pyulog and its tools read it, against the simulation's values."""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog

from xtdrone_autopilot.logger import sampled_topics
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.simulation import Simulation

ARMED_US, LANDING_US = 2_000_000, 12_000_000
CHANGED_US = 8_504_000

# the data of Flight Review's first plots (its configured_plots.py), also shown by PlotJuggler
SHOWN = {
    "vehicle_local_position": ["x", "y", "z", "vx", "vy", "vz"],
    "vehicle_local_position_setpoint": ["x", "y", "z", "vx", "vy", "vz"],
    "vehicle_attitude": ["q[0]", "q[1]", "q[2]", "q[3]"],
    "vehicle_attitude_setpoint": ["q_d[0]", "roll_body", "yaw_sp_move_rate"],
    "vehicle_angular_velocity": ["xyz[0]", "xyz[1]", "xyz[2]"],
    "vehicle_rates_setpoint": ["roll", "pitch", "yaw", "thrust_body[2]"],
    "rate_ctrl_status": ["rollspeed_integ"],
    "actuator_outputs": ["noutputs", "output[0]", "output[15]"],
    "actuator_motors": ["control[0]"],
    "battery_status": ["voltage_v", "voltage_filtered_v", "current_a", "discharged_mah", "remaining"],
    "vehicle_status": ["nav_state", "arming_state", "failsafe", "is_vtol", "vehicle_type"],
    "estimator_status": ["innovation_check_flags", "health_flags", "timeout_flags", "time_slip"],
    "estimator_innovations": ["gps_hpos[0]", "gps_hvel[1]", "baro_vpos", "heading"],
    "estimator_innovation_test_ratios": ["gps_hpos[0]", "gps_hvel[0]", "baro_vpos", "heading"],
    "sensor_combined": ["accelerometer_m_s2[0]", "gyro_rad[2]"],
    "vehicle_air_data": ["baro_alt_meter"],
    "vehicle_magnetometer": ["magnetometer_ga[0]"],
    "vehicle_gps_position": ["lat", "lon", "alt", "eph", "epv", "satellites_used", "fix_type", "noise_per_ms"],
    "vehicle_global_position": ["lat", "lon", "alt"],
    "position_setpoint_triplet": ["current.lat", "current.lon", "current.alt", "current.type"],
    "home_position": ["lat", "alt"],
    "vehicle_land_detected": ["landed"],
    "failsafe_flags": ["gcs_connection_lost", "battery_warning"],
    "failure_detector_status": ["fd_roll", "fd_motor"],
    "mission_result": ["seq_total", "finished"],
    "manual_control_setpoint": ["roll", "throttle", "valid"],
    "vehicle_command": ["command", "param1", "param7"],
    "vehicle_command_ack": ["command", "result"],
}


class Flight:
    """Two vehicles on the ground, of which the first takes off and lands; records during the flight."""

    def __init__(self, folder: Path, **parameters: float) -> None:
        self.folder = folder
        self.simulation = Simulation(parse_fleet("iris:2"), seed=3, autopilots=partial(BuiltinAutopilot, logs=folder))
        self.commander = self.simulation.commanders[0]
        for name, value in parameters.items():
            self.commander.parameters.set(name, value)
        self.records: dict[int, dict[str, np.ndarray]] = {}
        self.texts: list[str] = []

    def run_until(self, time_us: int) -> None:
        autopilot = self.simulation.autopilot
        while self.simulation.time_us < time_us:
            self.simulation.step()
            self.records[self.simulation.time_us] = {
                "gyro": autopilot.sensors["gyro"][0].copy(),
                "position": autopilot.estimator["position"][0].copy(),
                "q": autopilot.estimator["q"][0].copy(),
                "sp_rates": autopilot.control["sp_rates"][0].copy(),
                "actuators": autopilot.control["actuators"][0].copy(),
                "innov_pos": autopilot.estimator["innovation"]["pos"][0].copy(),
                "gps_lat": autopilot.sensors["gps_lat"][0].copy(),
            }

    def fly(self) -> None:
        self.run_until(ARMED_US)
        assert self.commander.request(modes.AUTO_TAKEOFF) == 0
        assert self.commander.arm_disarm(True) == 0
        self.run_until(CHANGED_US)
        self.commander.manual_control(0.25, -0.5, 0.75, 1.0)
        self.commander.on_command(511, (30.0, 1e6, math.nan, 0.0, 47.123456789, 8.5, -1.0), (255, 190), 2)
        self.commander.on_command(203, (0.0,) * 7, (255, 190), None)
        self.commander.parameters.set("MPC_XY_CRUISE", 4.0)
        self.run_until(LANDING_US)
        self.commander.commands.land()
        while self.commander.armed:
            self.run_until(self.simulation.time_us + 100_000)
        self.disarmed_us = self.simulation.time_us
        self.run_until(self.simulation.time_us + 2_000_000)
        self.simulation.close()
        self.texts = [text.rstrip("\t") for _, text in self.commander.texts]

    def log(self, vehicle: str = "iris_0") -> Path:
        (path,) = (self.folder / vehicle).rglob("*.ulg")
        return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    made = Flight(tmp_path_factory.mktemp("logs"))
    made.fly()
    return made


@pytest.fixture(scope="module")
def log(flight):
    read = ULog(str(flight.log()))
    assert not read.file_corruption
    return read


def column(log: ULog, topic: str, *fields: str) -> tuple[np.ndarray, np.ndarray]:
    data = log.get_dataset(topic).data
    return data["timestamp"], np.stack([data[field] for field in fields], axis=-1)


def test_name_and_text(flight):
    assert flight.log().relative_to(flight.folder).as_posix() == "iris_0/2020-01-01/00_00_00.ulg"
    assert flight.texts[0] == "[logger] ./log/2020-01-01/00_00_00.ulg"


def test_log_ends_a_second_after_disarming(flight, log):
    assert 1_000_000 <= log.last_timestamp - flight.disarmed_us <= 1_200_000
    other = ULog(str(flight.log("iris_1")))  # never armed: from boot until the end
    assert other.last_timestamp == max(flight.records)


def test_the_initial_view_exists(log):
    for topic, fields in SHOWN.items():
        data = log.get_dataset(topic).data
        for field in fields:
            assert field in data, f"{topic}.{field}"


def test_times_rise_at_px4s_rates(log):
    for data in log.data_list:
        assert (np.diff(data.data["timestamp"].astype(np.int64)) > 0).all(), data.name
    for topic in sampled_topics.TOPICS:
        steps = np.diff(log.get_dataset(topic.name).data["timestamp"].astype(np.int64))
        assert (steps[1:] == (topic.period_us or 4000)).mean() > 0.95, topic.name
        assert steps.max() <= 1.5 * (topic.period_us or 4000), topic.name


@pytest.mark.parametrize(
    ("topic", "fields", "record"),
    [
        ("sensor_combined", [f"gyro_rad[{i}]" for i in range(3)], "gyro"),
        ("vehicle_local_position", ["x", "y", "z"], "position"),
        ("vehicle_attitude", [f"q[{i}]" for i in range(4)], "q"),
        ("vehicle_rates_setpoint", ["roll", "pitch", "yaw"], "sp_rates"),
        ("estimator_innovations", ["gps_hpos[0]", "gps_hpos[1]", "gps_vpos"], "innov_pos"),
    ],
)
def test_values_are_the_records(flight, log, topic, fields, record):
    times, values = column(log, topic, *fields)
    assert len(times) > 20
    expected = np.array([flight.records[int(t)][record] for t in times])
    np.testing.assert_array_equal(values, expected.astype(np.float32))


def test_motors(flight, log):
    times, motors = column(log, "actuator_motors", *(f"control[{i}]" for i in range(12)))
    armed = (times > ARMED_US) & (times <= flight.disarmed_us - 100_000)
    expected = np.array([flight.records[int(t)]["actuators"][:4] for t in times[armed]])
    np.testing.assert_array_equal(motors[armed, :4], expected.astype(np.float32))
    assert np.isnan(motors[:, 4:]).all()
    assert np.isnan(motors[times < ARMED_US]).all()
    _, outputs = column(log, "actuator_outputs", *(f"output[{i}]" for i in range(4)))
    np.testing.assert_allclose(outputs[armed], 1000.0 + 1000.0 * expected, atol=1e-3)
    assert (outputs[times < ARMED_US] == 900.0).all()


def test_places(flight, log):
    times, lat = column(log, "vehicle_gps_position", "lat")
    assert lat[:, 0].tolist() == [round(float(flight.records[int(t)]["gps_lat"]) * 1e7) for t in times]
    estimate, place = column(log, "vehicle_global_position", "lat", "lon", "alt")
    view = flight.commander.view
    for t, here in zip(estimate, place, strict=True):
        x, y, z = flight.records[int(t)]["position"]
        np.testing.assert_allclose(here[:2], view.to_global((x, y, z))[:2], rtol=0.0, atol=1e-9)
    home = log.get_dataset("home_position").data
    assert home["lat"][-1] == pytest.approx(flight.commander.home.latitude, abs=1e-12)


def test_modes_and_arming(flight, log):
    status = log.get_dataset("vehicle_status")
    armed = [(t, state) for t, state in status.list_value_changes("arming_state")]
    assert [state for _, state in armed] == [1, 2, 1]
    assert 0 <= int(armed[1][0]) - ARMED_US <= 100_000
    # LOITER, TAKEOFF, LOITER at the height, LAND, LOITER after disarming
    assert [state for _, state in status.list_value_changes("nav_state")] == [4, 17, 4, 18, 4]
    took_off = log.get_dataset("vehicle_land_detected").list_value_changes("landed")
    assert [state for _, state in took_off] == [1, 0, 1]
    goals = log.get_dataset("position_setpoint_triplet").list_value_changes("current.type")
    assert [kind for _, kind in goals] == [5, 3, 2, 4, 5]


def test_parameters(flight, log):
    parameters = flight.commander.parameters
    assert log.initial_parameters["MPC_XY_CRUISE"] == 5.0
    assert log.initial_parameters["SDLOG_MODE"] == 1
    (time_us, name, value), *counted = log.changed_parameters
    assert (name, value) == ("MPC_XY_CRUISE", 4.0)
    assert {name for _, name, _ in counted} <= {"COM_FLIGHT_UUID", "LND_FLIGHT_T_LO", "LND_FLIGHT_T_HI"}  # at disarming
    assert 0 <= time_us - CHANGED_US <= 1
    for name, value in log.get_default_parameters(1).items():
        assert value == pytest.approx(parameters.default(name))
        assert value != pytest.approx(log.initial_parameters[name])
    second = ULog(str(flight.log("iris_1")))
    assert second.initial_parameters["MAV_SYS_ID"] == 2
    assert second.get_default_parameters(0)["MAV_SYS_ID"] == 1
    assert "MAV_SYS_ID" not in second.get_default_parameters(1)  # the fleet's own value is unchanged


def test_commands_and_sticks(log):
    commands = log.get_dataset("vehicle_command").data
    assert commands["command"].tolist() == [511, 203]
    assert commands["timestamp"].tolist() == [CHANGED_US, CHANGED_US + 1]  # the times of a topic increase
    assert (commands["param1"][0], commands["param5"][0]) == (30.0, 47.123456789)
    assert math.isnan(commands["param3"][0])
    acks = log.get_dataset("vehicle_command_ack").data
    assert (acks["command"].tolist(), acks["result"].tolist()) == ([511], [2])
    assert (acks["target_system"][0], acks["target_component"][0]) == (255, 190)
    sticks = log.get_dataset("manual_control_setpoint").data
    assert [sticks[name][0] for name in ("pitch", "roll", "throttle", "yaw")] == [0.25, -0.5, 0.75, 1.0]


def test_texts(flight, log):
    logged = [m.message for m in log.logged_messages]
    assert logged == flight.texts
    levels = {m.message: m.log_level_str() for m in log.logged_messages}
    assert levels["Takeoff detected"] == "INFO"
    by_time = {m.message: m.timestamp for m in log.logged_messages}
    assert by_time["Armed by external command"] == ARMED_US


def tool(name: str, *arguments: object, folder: Path) -> str:
    """Run one of pyulog's programs; it must report no error."""
    program = Path(sys.executable).with_name(name)
    done = subprocess.run(
        [str(program), *map(str, arguments)], capture_output=True, text=True, cwd=folder, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert not [line for line in done.stdout.lower().splitlines() if "warning" in line or "corrupt" in line]
    return done.stdout


def test_pyulogs_tools(flight, tmp_path):
    path = flight.log()
    shown = tool("ulog_info", path, folder=tmp_path)
    assert "SW Version: v1.14.3" in shown
    assert "No Dropouts" in shown
    assert "vehicle_local_position (0, 167)" in shown
    assert "MPC_XY_CRUISE,5.0" in tool("ulog_params", path, folder=tmp_path).replace(" ", "")
    assert "INFO: Takeoff detected" in tool("ulog_messages", path, folder=tmp_path)
    tool("ulog2csv", "-o", tmp_path, path, folder=tmp_path)
    rows = (tmp_path / "00_00_00_vehicle_attitude_0.csv").read_text().splitlines()
    assert rows[0].startswith("timestamp,timestamp_sample,q[0]")
    assert len(rows) > 100
    tool("ulog2kml", "-o", tmp_path / "track.kml", path, folder=tmp_path)
    assert "<coordinates>" in (tmp_path / "track.kml").read_text()


def test_same_flight_same_bytes(flight, tmp_path):
    again = Flight(tmp_path)
    again.fly()
    for vehicle in ("iris_0", "iris_1"):
        assert again.log(vehicle).read_bytes() == flight.log(vehicle).read_bytes()


def test_logging_changes_nothing(flight):
    silent = Simulation(parse_fleet("iris:2"), seed=3)
    silent.run_until(ARMED_US)
    np.testing.assert_array_equal(silent.autopilot.estimator["position"][0], flight.records[ARMED_US]["position"])
    silent.close()


def test_tail_cut_anywhere(flight, tmp_path, capsys):
    """A log without its last bytes is read without a warning."""
    whole = flight.log().read_bytes()
    cut = tmp_path / "cut.ulg"
    for missing in range(0, 400):
        cut.write_bytes(whole[: len(whole) - missing])
        if missing % 20 == 0 or missing < 60:
            assert not ULog(str(cut), message_name_filter_list=["vehicle_status"]).file_corruption
    assert capsys.readouterr().out == ""


_CRASH = """
import os, signal, sys
from functools import partial
from pathlib import Path
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.simulation import Simulation
simulation = Simulation(parse_fleet("iris:1"), autopilots=partial(BuiltinAutopilot, logs=Path(sys.argv[1])))
simulation.run_until(3_900_000)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_data_written_before_a_crash_is_readable(tmp_path):
    done = subprocess.run([sys.executable, "-c", _CRASH, str(tmp_path)], capture_output=True, timeout=200, check=False)
    assert done.returncode == -signal.SIGKILL
    (path,) = tmp_path.rglob("*.ulg")
    log = ULog(str(path))
    assert not log.file_corruption
    assert log.last_timestamp >= 2_900_000  # at most a second is lost


@pytest.mark.parametrize(
    ("mode", "starts"),
    [(-1, []), (0, [1]), (1, [0]), (2, [0]), (4, [1])],
)
def test_modes_of_logging(tmp_path, mode, starts):
    """SDLOG_MODE selects when a log begins: at boot, or at the first arming after 1 s."""
    flight = Flight(tmp_path, SDLOG_MODE=mode) if mode == 1 else _booted_with(tmp_path, mode)
    flight.run_until(1_000_000)
    flight.commander.arm_disarm(True)
    flight.run_until(2_000_000)
    flight.commander.arm_disarm(False)
    flight.run_until(4_000_000)
    flight.commander.arm_disarm(True)
    flight.run_until(5_000_000)
    flight.simulation.close()
    names = sorted(p.name for p in (tmp_path / "iris_0").rglob("*.ulg"))
    again = [4] if mode in (0, 1) else []
    assert names == [f"00_00_{second:02d}.ulg" for second in starts + again]


def _booted_with(folder: Path, mode: int) -> Flight:
    """Return a flight whose vehicle has booted with that SDLOG_MODE."""
    flight = Flight(folder)
    flight.commander.parameters.set("SDLOG_MODE", mode)
    flight.simulation.restart(0)
    flight.commander = flight.simulation.commanders[0]
    shutil.rmtree(folder)
    flight.simulation.restart(0)
    flight.commander = flight.simulation.commanders[0]
    return flight


def test_an_older_log_is_kept(tmp_path):
    for _ in range(2):
        simulation = Simulation(parse_fleet("iris:1"), autopilots=partial(BuiltinAutopilot, logs=tmp_path))
        simulation.run_until(400_000)
        (_, text), *_ = simulation.commanders[0].texts
        simulation.close()
        assert text == "[logger] ./log/2020-01-01/00_00_00.ulg\t"  # the same in every run
    assert sorted(p.name for p in tmp_path.rglob("*.ulg")) == ["00_00_00.ulg", "00_00_00_1.ulg"]


def test_local_time_in_names(tmp_path):
    flight = Flight(tmp_path)
    flight.commander.parameters.set("SDLOG_UTC_OFFSET", -90)
    flight.simulation.restart(0)
    flight.simulation.close()
    path = tmp_path / "iris_0/2019-12-31/22_30_00.ulg"
    assert ULog(str(path)).msg_info_dict["time_ref_utc"] == -5400


def test_a_disk_that_cannot_be_written_ends_the_log_not_the_flight(tmp_path, caplog):
    (tmp_path / "iris_0").write_text("no folder")
    flight = Flight(tmp_path)
    flight.run_until(2_000_000)
    assert math.isfinite(float(flight.simulation.autopilot.estimator["position"][0][2]))
    assert [text for _, text in flight.commander.texts] == ["[logger] failed to write the log"]
    (error,) = [r for r in caplog.records if r.levelname == "ERROR"]
    assert "iris_0" in error.getMessage()
    flight.simulation.close()
    assert os.listdir(tmp_path / "iris_1") == ["2020-01-01"]
