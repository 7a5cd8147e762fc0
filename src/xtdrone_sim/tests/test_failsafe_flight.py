"""Failsafes flown on the whole core; simulated times are held to 0.2 s."""

from __future__ import annotations

import math

import pytest

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.state import FAILURE_OFF
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

TICK_US = 20_000
HOVER = 4.0  # m
TOLERANCE = 0.2  # s


class Sortie:
    """One vehicle that hovers at 4 m in AUTO.LOITER, flown by its commander alone."""

    def __init__(self, **parameters: float) -> None:
        self.simulation = Simulation(parse_fleet("iris:1"))
        self.commander = self.simulation.commanders[0]
        self.said: list[str] = []
        self.named: list[str] = []
        self.each = None
        self.armed = self.took_off = 0.0
        for name, value in {"MIS_TAKEOFF_ALT": HOVER, "MPC_TKO_SPEED": 3.0, **parameters}.items():
            self.commander.parameters.set(name, value)

    def take_off(self) -> Sortie:
        self.run(2.0)
        assert self.commander.request(modes.AUTO_TAKEOFF) == 0
        assert self.commander.arm_disarm(True) == 0
        self.armed = self.now
        self.until(lambda: not self.commander.view.landed, 5.0)
        self.took_off = self.now
        self.until(lambda: self.commander.mode is modes.AUTO_LOITER, 15.0)
        self.run(1.0)
        self.said.clear()
        self.named.clear()
        return self

    @property
    def now(self) -> float:
        return self.simulation.time_us * 1e-6

    @property
    def height(self) -> float:
        return float(self.simulation.world.plant["position"][0][2])

    @property
    def failures(self):
        return self.simulation.autopilot.failures[0]

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e6 / TICK_US)):
            if self.each is not None:
                self.each()
            self.simulation.run_until(self.simulation.time_us + TICK_US)
            while self.commander.texts:
                self.said.append(self.commander.texts.popleft()[1].rstrip("\t"))
            while self.commander.events:
                self.named.append(self.commander.events.popleft().name)

    def until(self, done, limit: float) -> float:
        """Fly on until ``done()``; return the elapsed time, s."""
        start = self.now
        while not done():
            assert self.now - start < limit, f"not within {limit} s; {self.commander.mode.label}; {self.said}"
            self.run(TICK_US * 1e-6)
        return self.now - start

    def until_mode(self, mode: modes.Mode, limit: float = 12.0) -> float:
        return self.until(lambda: self.commander.mode is mode, limit)

    def until_down(self, limit: float = 25.0) -> float:
        seconds = self.until(lambda: not self.commander.armed, limit)
        assert self.height < 0.3
        return seconds

    def sticks(self, x=0.0, y=0.0, z=0.0, yaw=0.0) -> None:
        self.each = lambda: self.commander.manual_control(x, y, z, yaw)

    def hover_offboard(self) -> None:
        x, y, z = self.commander.view.position
        nan = (math.nan,) * 3
        self.each = lambda: self.commander.offboard.set_trajectory((x, y, z), nan, nan, 0.0, math.nan)
        self.run(0.3)
        assert self.commander.request(modes.OFFBOARD) == 0
        self.run(1.0)


@pytest.fixture
def sortie():
    flights = []

    def fly(**parameters):
        flights.append(Sortie(**parameters).take_off())
        return flights[-1]

    yield fly
    for flight in flights:
        flight.simulation.close()


@pytest.mark.parametrize(("action", "mode"), [(0, modes.POSCTL), (4, modes.AUTO_LAND), (5, modes.AUTO_LOITER)])
def test_offboard_loss_acts_at_once(sortie, action, mode):
    flight = sortie(COM_OBL_RC_ACT=action)
    flight.hover_offboard()
    flight.each = None
    assert flight.until_mode(mode) == pytest.approx(1.03, abs=TOLERANCE)
    assert "Failsafe activated" in flight.said
    assert "commander_failsafe_enter_generic" in flight.named
    assert flight.commander.system_status == 5
    if action == 0:
        assert flight.commander.base_mode == 209
        flight.until_down()


def test_loss_of_the_pilot(sortie):
    flight = sortie(COM_FAIL_ACT_T=2.0, NAV_RCL_ACT=3)
    flight.sticks()
    flight.run(0.5)
    assert flight.commander.request(modes.POSCTL) == 0
    flight.run(1.0)
    flight.each = None
    assert flight.until_mode(modes.AUTO_LOITER) == pytest.approx(0.5, abs=TOLERANCE)
    assert flight.until_mode(modes.AUTO_LAND) == pytest.approx(2.0, abs=TOLERANCE)
    assert "Failsafe activated, entering Hold for 2 seconds" in flight.said
    assert {"commander_rc_lost", "commander_failsafe_enter_hold", "commander_failsafe_enter"} <= set(flight.named)


def test_the_pilot_returns_and_takes_over(sortie):
    flight = sortie(COM_FAIL_ACT_T=1.0)
    flight.sticks()
    flight.run(0.5)
    flight.commander.request(modes.POSCTL)
    flight.run(0.5)
    flight.each = None
    flight.until_mode(modes.AUTO_RTL)
    flight.sticks()
    flight.run(0.5)
    assert flight.commander.mode is modes.AUTO_RTL, "until the pilot requests it"
    flight.sticks(x=0.6)
    assert flight.until_mode(modes.POSCTL) == pytest.approx(0.1, abs=TOLERANCE)
    assert flight.commander.system_status == 4


@pytest.mark.parametrize(("action", "mode"), [(1, modes.AUTO_LOITER), (2, modes.AUTO_RTL), (3, modes.AUTO_LAND)])
def test_loss_of_the_ground_station(sortie, action, mode):
    flight = sortie(COM_DL_LOSS_T=5, COM_FAIL_ACT_T=1.0)
    flight.hover_offboard()
    flight.commander.gcs_heartbeat()
    flight.commander.parameters.set("NAV_DLL_ACT", action)
    assert flight.until(lambda: flight.commander.failsafe, 8.0) == pytest.approx(5.0, abs=TOLERANCE)
    assert flight.commander.mode is modes.AUTO_LOITER
    assert "Connection to ground station lost" in flight.said
    if action > 1:
        assert flight.until_mode(mode) == pytest.approx(1.0, abs=TOLERANCE)


def test_loss_of_the_ground_station_is_only_announced_by_default(sortie):
    flight = sortie(COM_DL_LOSS_T=5)
    flight.commander.gcs_heartbeat()
    flight.run(5.3)
    assert flight.said == ["Connection to ground station lost"]
    assert not flight.commander.failsafe


def test_a_draining_battery_warns_and_then_lands_the_vehicle(sortie):
    """The battery drains as in PX4's simulator, in SIM_BAT_DRAIN; BAT_CRIT_THR 7 %, COM_LOW_BAT_ACT 2."""
    flight = sortie(SIM_BAT_DRAIN=25.0, SIM_BAT_MIN_PCT=0.0, BAT1_V_LOAD_DROP=0.0, COM_FAIL_ACT_T=1.0)
    flight.until(lambda: "commander_failsafe_enter_low_bat" in flight.named, 25.0)
    assert flight.now - flight.armed == pytest.approx(25.0 * 0.85, abs=TOLERANCE)
    assert flight.commander.mode is modes.AUTO_LOITER
    assert not flight.commander.failsafe
    flight.until(lambda: flight.commander.failsafe, 5.0)
    assert flight.now - flight.armed == pytest.approx(25.0 * 0.93, abs=TOLERANCE)
    assert flight.until_mode(modes.AUTO_LAND) == pytest.approx(1.0, abs=TOLERANCE)
    assert flight.commander.battery.warning >= 2
    flight.until_down()
    flight.run(3.0)
    assert flight.commander.battery.remaining == pytest.approx(1.0), "a new one is put in"


def test_a_battery_that_fails(sortie):
    flight = sortie(COM_FAIL_ACT_T=0.0)
    flight.failures["battery"] = FAILURE_OFF
    assert flight.until_mode(modes.AUTO_LAND) == pytest.approx(0.1, abs=TOLERANCE)
    assert flight.commander.battery.warning == 3


@pytest.mark.parametrize(
    ("action", "mode"),
    [(1, modes.OFFBOARD), (2, modes.AUTO_LOITER), (3, modes.AUTO_RTL), (5, modes.AUTO_LAND)],
)
def test_a_breached_geofence(sortie, action, mode):
    flight = sortie(GF_ACTION=action, GF_MAX_VER_DIST=6.0, COM_FAIL_ACT_T=0.0)
    flight.hover_offboard()
    x, y, z = flight.commander.view.position
    nan = (math.nan,) * 3
    flight.each = lambda: flight.commander.offboard.set_trajectory((x, y, z - 4.0), nan, nan, 0.0, math.nan)
    home = flight.commander.home.position[2]
    flight.until(lambda: home - flight.commander.view.position[2] > 6.0, 10.0)
    if action == 1:
        flight.run(0.3)
        assert "commander_failsafe_enter_generic_warn" in flight.named
        assert flight.commander.mode is modes.OFFBOARD
        return
    assert flight.until_mode(mode) < TOLERANCE
    assert flight.commander.failsafe


def test_a_mission_into_a_fence_is_stopped(sortie):
    flight = sortie(GF_ACTION=2)
    x, y, _ = flight.commander.view.position
    far = flight.commander.view.to_global((x + 20.0, y, -HOVER))
    item = PlanItem(command=16, frame=6, params=(0.0, 0.0, 0.0, math.nan), x=far[0], y=far[1], z=HOVER)
    flight.commander.navigator.set_plan(plan.MISSION, [item], 0)
    assert flight.commander.request(modes.AUTO_MISSION) == 0
    flight.run(0.5)
    flight.commander.parameters.set("GF_MAX_HOR_DIST", 10.0)  # only now: otherwise PX4 would have rejected the mission
    flight.until(lambda: flight.commander.health.breach, 12.0)
    assert flight.until_mode(modes.AUTO_LOITER) < TOLERANCE


def _goto(flight, north):
    """Send the vehicle ``north`` metres from its position, by DO_REPOSITION."""
    x, y, z = flight.commander.view.position
    place = flight.commander.view.to_global((x + north, y, z))
    return flight.commander.commands.reposition(place, math.nan, math.nan)


@pytest.mark.parametrize("delay", [0.0, 5.0])
def test_a_flight_to_a_place_beyond_the_fence_is_stopped_at_the_fence(sortie, delay):
    flight = sortie(GF_ACTION=2, COM_FAIL_ACT_T=delay)
    start = flight.commander.view.position[0]
    assert _goto(flight, 30.0) == 0
    flight.commander.parameters.set("GF_MAX_HOR_DIST", 15.0)  # only now: before, the position would be rejected
    flight.until(lambda: flight.commander.health.breach, 12.0)
    flight.run(8.0)
    assert flight.commander.mode is modes.AUTO_LOITER
    assert flight.commander.view.position[0] - start < 22.0
    assert math.hypot(*flight.commander.view.velocity[:2]) < 0.3


def test_a_place_beyond_the_fence_is_rejected(sortie):
    flight = sortie(GF_ACTION=2, GF_MAX_HOR_DIST=15.0)
    start = flight.commander.view.position[0]
    assert _goto(flight, 30.0) == 0  # PX4's commander accepts what its navigator then rejects
    flight.run(5.0)
    assert "Reposition is outside geofence" in flight.said
    assert "navigator_reposition_outside_geofence" in flight.named
    assert flight.commander.view.position[0] - start < 1.0
    assert _goto(flight, 10.0) == 0
    flight.until(lambda: flight.commander.view.position[0] - start > 9.0, 12.0)


def test_a_return_without_a_position_descends_blind(sortie):
    flight = sortie()
    flight.failures["gps"] = FAILURE_OFF
    estimator = flight.simulation.autopilot.estimator[0]
    flight.until(lambda: not estimator["position_valid"], 20.0)
    assert flight.until_mode(modes.DESCEND) == pytest.approx(1.0, abs=TOLERANCE), "COM_POS_FS_DELAY"
    assert flight.commander.custom_mode == modes.AUTO_LAND.custom_mode
    assert flight.commander.landed_state == 4
    flight.until_down()


def test_a_motor_that_stops_is_found_by_its_current(sortie):
    flight = sortie(COM_ACT_FAIL_ACT=2, COM_FAIL_ACT_T=0.0)
    flight.failures["motor"][2] = FAILURE_OFF
    assert flight.until(lambda: flight.commander.health.detector.motors, 2.0) == pytest.approx(0.2, abs=TOLERANCE)
    assert flight.commander.health.detector.motors == (2,)
    assert flight.until_mode(modes.AUTO_LAND, 1.0) < TOLERANCE
    flight.run(2.0)
    assert "check_failure_detector_motor" in flight.named


@pytest.mark.parametrize(("breaker", "action"), [(121212, "warn"), (0, "terminate")])
def test_the_attitude_limit(sortie, breaker, action):
    """Attitude setpoints command a bank beyond FD_FAIL_R."""
    flight = sortie(CBRK_FLIGHTTERM=breaker, FD_FAIL_R=20, COM_LKDOWN_TKO=0.0)
    flight.hover_offboard()
    half = math.radians(30.0) / 2
    bank = (math.cos(half), math.sin(half), 0.0, 0.0)
    flight.each = lambda: flight.commander.offboard.set_attitude(bank, 0.0, 0.6)
    q = flight.simulation.autopilot.estimator["q"][0]
    flight.until(lambda: 2.0 * math.atan2(abs(q[1]), q[0]) > math.radians(20.0), 3.0)
    flight.until(lambda: flight.commander.health.detector.attitude, 2.0)
    flight.run(0.1)
    if action == "warn":
        assert flight.commander.mode is modes.OFFBOARD
        assert "commander_failsafe_enter_generic_warn" in flight.named
        return
    assert flight.commander.mode is modes.TERMINATION
    assert flight.commander.system_status == 8
    assert flight.simulation.autopilot.setpoint[0]["armed"] == 0
    assert flight.commander.request(modes.AUTO_LOITER) == 1


def test_the_attitude_limit_at_takeoff_disarms(sortie):
    flight = Sortie(FD_FAIL_R=1, FD_FAIL_R_TTRI=0.02)
    flight.run(2.0)
    roll = math.radians(3.0) / 2
    assert flight.commander.arm_disarm(True) == 0
    flight.simulation.autopilot.estimator["q"][0] = (math.cos(roll), math.sin(roll), 0.0, 0.0)
    flight.until(lambda: not flight.commander.armed, 1.0)
    assert "Disarmed by failsafe" in flight.said
    flight.simulation.close()


def test_flight_termination_by_command(sortie):
    flight = sortie(COM_DISARM_LAND=-1.0)  # it falls, and landing detection would disarm it
    assert flight.commander.flight_termination(2.0) == 0
    flight.run(0.1)
    assert flight.simulation.autopilot.setpoint[0]["armed"] == 0
    assert flight.commander.system_status == 8
    assert flight.until(lambda: not flight.commander.armed, 8.0) == pytest.approx(4.9, abs=TOLERANCE)
    assert flight.said[-1] == "Disarmed by lockdown"


def test_a_terminated_vehicle_cannot_be_armed_again(sortie):
    flight = sortie()
    assert flight.commander.flight_termination(1.0) == 0
    flight.until(lambda: not flight.commander.armed, 15.0)
    assert flight.commander.arm_disarm(True, force=True) == 1
    flight.run(0.1)
    assert any(text.startswith("Arming denied: flight was terminated") for text in flight.said)


def test_flight_time_limit(sortie):
    flight = sortie(COM_FLT_TIME_MAX=8, COM_FAIL_ACT_T=0.0)
    flight.until_mode(modes.AUTO_RTL)
    assert flight.now - flight.took_off == pytest.approx(8.0, abs=TOLERANCE)
