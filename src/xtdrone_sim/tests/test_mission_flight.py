"""The square flown by a real PX4 v1.14.3: same order of texts, modes and items, and similar times."""

from __future__ import annotations

import math

import pytest

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import PlanItem
from xtdrone_control.fleet import parse_fleet
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
