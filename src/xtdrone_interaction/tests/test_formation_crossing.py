"""A formation's flight through obstacles: setpoints, end conditions, and the figures of its record."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_interaction.missions.crossing.metrics import measure_formation
from xtdrone_interaction.missions.crossing.state_machine import FORMED_ERROR, FormationCrossing, Member
from xtdrone_interaction.missions.fleet_record import FleetRecord

PERIOD = 0.1  # s


class Flight:
    """A formation of three vehicles that follow commands exactly."""

    def __init__(self) -> None:
        self.mission = FormationCrossing([Member(f"uav_{k}", (9.0, 0.0, 2.0), 100.0) for k in range(3)], 100.0)
        self.time = 0.0
        self.errors: list[float] | None = None
        self.sent: list[str] = []
        for member in self.mission.members:
            member.reports.mode, member.reports.planner = "AUTO.LOITER", "waiting"

    def step(self) -> None:
        for member in self.mission.members:
            for command in member.step(self.time):
                assert command != "GOAL"
                if command == "ARM":
                    member.reports.armed = True
                elif command == "AUTO.LAND":
                    member.reports.armed = False
        self.sent += self.mission.step(self.time, self.errors)
        self.time += PERIOD

    def run(self, stage: str, limit: float = 200.0) -> None:
        end = self.time + limit
        while self.mission.stage != stage:
            assert self.time < end, self.mission.stage
            self.step()


def test_it_forms_crosses_forms_again_and_lands():
    flight = Flight()
    flight.run("forming")
    assert flight.sent == ["pattern"]
    flight.errors = [3.0, 0.1]
    for _ in range(30):
        flight.step()
    assert flight.sent == ["pattern", "slots"]
    flight.errors = [0.9 * FORMED_ERROR, 0.1]
    flight.run("crossing", 3.0)
    assert flight.sent == ["pattern", "slots", "goal"]
    flight.errors = [4.0, 4.0]
    for _ in range(50):
        flight.step()
    flight.mission.members[0].reports.planner = "hovering at the goal"
    flight.run("forming again", 1.0)
    for _ in range(50):
        flight.step()
    assert flight.mission.stage == "forming again"
    flight.errors = [0.1, 0.1]
    flight.run("over", 10.0)
    assert [member.outcome for member in flight.mission.members] == ["arrived"] * 3
    assert all(member.phase == "landed" for member in flight.mission.members)
    assert flight.mission.members[0].ended - flight.mission.members[0].begun == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize(
    ("case", "outcome"),
    [
        ("never formed", "not in formation within 60 s"),
        ("unreachable", "uav_0: goal unreachable"),
        ("late", "the leader has not arrived within 100 s"),
        ("lost", "another vehicle has failed"),
        ("not formed again", "not in formation again within 60 s"),
    ],
)
def test_what_goes_wrong_lands_all_and_is_named(case: str, outcome: str):
    flight = Flight()
    flight.run("forming")
    flight.errors = [9.0, 0.1] if case == "never formed" else [0.1, 0.1]
    if case != "never formed":
        flight.run("crossing", 5.0)
    leader = flight.mission.members[0].reports
    if case == "unreachable":
        leader.planner = "goal unreachable"
    elif case == "lost":
        flight.mission.members[1].reports.armed = False
    elif case == "not formed again":
        leader.planner, flight.errors = "hovering at the goal", [float("nan"), 0.1]
    flight.run("over")
    assert flight.mission.members[2].outcome == outcome
    assert flight.mission.members[2].phase == "failed"
    if case == "lost":
        assert flight.mission.members[1].outcome == "the vehicle has disarmed in flight"


def test_figures_are_those_of_the_stages():
    time = np.arange(0.0, 40.0, PERIOD)
    leader = np.column_stack([time, np.zeros_like(time), np.full_like(time, 2.0)])
    away = np.where(time < 10.0, 0.1, np.where(time < 20.0, 2.0, 0.2))
    follower = leader + np.column_stack([-3.0 - away, np.zeros_like(time), np.zeros_like(time)])
    events = [
        {"event": "phase", "phase": "forming", "time": 2.0},
        {"event": "assigned", "time": 3.0, "pattern": "circle", "offsets": [[-3.0, 0.0, 0.0]]},
        {"event": "phase", "phase": "crossing", "time": 9.0},
        {"event": "phase", "phase": "forming again", "time": 19.95},
        {"event": "phase", "phase": "landing", "time": 30.0},
        {"event": "landing", "vehicle": "uav_0", "outcome": "arrived", "time": 30.0},
    ]
    record = FleetRecord(("uav_0", "uav_1"), time, np.stack([leader, follower], axis=1), events, [])
    figures = measure_formation(record)
    assert figures is not None
    assert figures["before"] == pytest.approx({"mean": 0.1, "most": 0.1})
    assert figures["during"]["most"] == pytest.approx(2.0)
    assert figures["during"]["mean"] == pytest.approx(1.83, abs=0.03)
    assert figures["after"] == pytest.approx({"mean": 0.2, "most": 0.2})
    assert figures["formed_after"] == pytest.approx(6.0)
    assert figures["formed_again_after"] == pytest.approx(10.05)
    events[:2] = []
    assert measure_formation(record) is None
