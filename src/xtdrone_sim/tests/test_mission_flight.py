"""The square flown by a real PX4 v1.14.3: same order of texts, modes and items, and similar times."""

from __future__ import annotations

import math

import pytest

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

REFERENCE_TIME = 39.3  # s from the mode command to the end
ARMED_AFTER = 1.3  # s, as in the reference
# times since the mode command, s, of PX4's texts
REFERENCE = (
    ("Armed by external command", 1.32),
    ("Takeoff to 10.0 meters above home", 1.37),
    ("Takeoff detected", 3.28),
    ("reached 0", 14.55),
    ("current 1", 14.57),
    ("reached 1", 20.44),
    ("current 2", 20.52),
    ("reached 2", 26.64),
    ("current 3", 26.68),
    ("reached 3", 32.84),
    ("current 4", 32.86),
    ("reached 4", 39.29),
    ("Mission finished, loitering", 39.29),
    ("AUTO.LOITER", 39.9),
)
SIDE = ((0, 0), (20, 0), (20, 20), (0, 20), (0, 0))


class Recorder:
    """A simulation, and its vehicle's messages with their times in s since ``start``."""

    def __init__(self) -> None:
        self.simulation = Simulation(parse_fleet("iris:1"), seed=5)
        self.commander = self.simulation.commanders[0]
        self.said: list[tuple[str, float]] = []
        self.start = 0
        self._last = (-1, 0, modes.AUTO_MISSION)

    def note(self, text: str) -> None:
        self.said.append((text, (self.simulation.time_us - self.start) * 1e-6))

    def look(self) -> None:
        navigator = self.commander.navigator
        reached, current, mode = navigator.mission.reached, navigator.plans.current, self.commander.mode
        if reached != self._last[0]:
            self.note(f"reached {reached}")
        if current != self._last[1]:
            self.note(f"current {current}")
        while self.commander.texts:
            self.note(self.commander.texts.popleft()[1].rstrip("\t"))
        if mode is not self._last[2]:
            self.note(mode.name)
        self._last = (reached, current, mode)

    def run(self, seconds: float) -> None:
        """Fly on, at most to the mission's end."""
        end = self.simulation.time_us + round(seconds * 1e6)
        while self.simulation.time_us < end and self.commander.mode is modes.AUTO_MISSION:
            self.simulation.step()
            self.look()


def square(view, x, y):
    items = []
    for i, (north, east) in enumerate(SIDE):
        latitude, longitude, _ = view.to_global((x + north, y + east, 0.0))
        items.append(
            PlanItem(plan.WAYPOINT if i else plan.TAKEOFF, 6, (0.0, 0.0, 0.0, math.nan), latitude, longitude, 10.0)
        )
    return items


@pytest.fixture(scope="module")
def flown():
    recorder = Recorder()
    simulation, commander = recorder.simulation, recorder.commander
    simulation.run_until(3_000_000)
    x, y, _ = commander.view.position
    commander.navigator.set_plan(plan.MISSION, square(commander.view, x, y), 0)
    recorder.start = simulation.time_us
    assert commander.request(modes.AUTO_MISSION) == 0
    recorder.run(ARMED_AFTER)
    assert commander.arm_disarm(True) == 0
    recorder.run(80.0)
    yield recorder
    simulation.close()


def test_the_order_is_px4s(flown):
    assert [text for text, _ in flown.said] == [text for text, _ in REFERENCE]


def test_it_has_px4s_duration(flown):
    assert dict(flown.said)["Mission finished, loitering"] == pytest.approx(REFERENCE_TIME, rel=0.1)


def test_the_sides_have_px4s_duration(flown):
    ours, theirs = dict(flown.said), dict(REFERENCE)
    for side in range(1, 5):
        took = ours[f"reached {side}"] - ours[f"reached {side - 1}"]
        expected = theirs[f"reached {side}"] - theirs[f"reached {side - 1}"]
        assert took == pytest.approx(expected, rel=0.2), side


def test_a_plan_outlives_a_reboot(flown):
    simulation = flown.simulation
    before = simulation.commanders[0].navigator.plans.mission
    simulation.restart()
    navigator = simulation.commanders[0].navigator
    assert len(before) == 5
    assert navigator.plans.mission == before
    simulation.run_until(3_000_000)
    assert navigator.mission_denial() == ""


# behind a waypoint 40 m north and before one 40 m east of it; the largest speed, m/s, from 4 s after it is reached
TAKES_TIME = {
    "delay": (PlanItem(plan.DELAY, 2, (8.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0), 0.1),
    "gripper": (PlanItem(plan.GRIPPER, 2, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0), 0.1),
    "hold at the waypoint": (8.0, 0.1),
    "nothing": (0.0, math.inf),
}


def _corner(view, item):
    """Return a mission with a corner: ``item`` behind its waypoint, or the seconds to hold there."""
    x, y, _ = view.position
    hold, between = (item, []) if isinstance(item, float) else (0.0, [item])

    def at(command, north, east, seconds=0.0):
        latitude, longitude, _ = view.to_global((x + north, y + east, 0.0))
        return PlanItem(command, 6, (seconds, 0.0, 0.0, math.nan), latitude, longitude, 10.0)

    corner = at(plan.WAYPOINT, 40, 0, hold)
    return [at(plan.TAKEOFF, 0, 0), corner, *between, at(plan.WAYPOINT, 40, 40)]


def test_the_vehicle_stands_while_an_item_takes_time():
    """PX4 Mission::set_mission_items, brake_for_hold; without such an item it flies through the corner."""
    simulation = Simulation(parse_fleet(f"iris:{len(TAKES_TIME)}"), seed=5)
    try:
        simulation.run_until(3_000_000)
        for commander, (item, _) in zip(simulation.commanders, TAKES_TIME.values(), strict=True):
            commander.navigator.set_plan(plan.MISSION, _corner(commander.view, item), 0)
            commander.parameters.set("MIS_PD_TO", 8.0)
            assert commander.request(modes.AUTO_MISSION) == 0
            assert commander.arm_disarm(True) == 0
        fastest = dict.fromkeys(TAKES_TIME, 0.0)
        farthest = dict.fromkeys(TAKES_TIME, 0.0)
        slowest = dict.fromkeys(TAKES_TIME, math.inf)
        since: dict[str, int] = {}
        while simulation.time_us < 38_000_000:
            simulation.step()
            for name, commander in zip(TAKES_TIME, simulation.commanders, strict=True):
                goal, view = commander.view.setpoint["goal_position"], commander.view
                away = math.hypot(view.position[0] - goal[0], view.position[1] - goal[1])
                speed = math.hypot(*view.velocity[:2])
                current, last = commander.navigator.plans.current, len(commander.navigator.plans.mission) - 1
                if name not in since and current >= 1 and away < 2.0:
                    since[name] = simulation.time_us
                if name in since and current < last and simulation.time_us > since[name] + 4_000_000:
                    fastest[name], farthest[name] = max(fastest[name], speed), max(farthest[name], away)
                if name in since and simulation.time_us < since[name] + 3_000_000:
                    slowest[name] = min(slowest[name], speed)
        for name, (_, limit) in TAKES_TIME.items():
            if math.isinf(limit):
                assert slowest[name] > 0.5, name
            else:
                assert 0.0 < fastest[name] < limit, name
                assert farthest[name] < 0.3, name
    finally:
        simulation.close()
