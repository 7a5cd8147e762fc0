"""The mission with a fleet of points that follow commands exactly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from xtdrone_interaction.command_options import swarm_patterns
from xtdrone_interaction.missions.formation.state_machine import (
    CLEARANCE,
    COMMAND_LIMIT,
    FleetState,
    FormationMission,
    MissionError,
)

STEP = 1.0 / 30.0
COUNT = 9
PATTERNS = ["cube", "pyramid", "triangle"]


class PointFleet:
    """Vehicles without dynamics behind the mission's commands."""

    def __init__(self, patterns: list[str] = PATTERNS, count: int = COUNT) -> None:
        self.slots = swarm_patterns(count, patterns)
        self.view = FleetState([f"iris_{i}" for i in range(count)])
        self.view.connected = [True] * count
        self.view.position = np.vstack([np.zeros(3), self.slots["origin"]]) + np.array([1.0, 2.0, 0.0])
        self.mission = FormationMission(self.view, self, patterns, self.slots)
        self.log: list[tuple[int, str]] = []
        self.events: list[dict[str, Any]] = []
        self.velocity = np.zeros(3)
        self.refuses: Callable[[int, str], bool] = lambda index, command: False
        self.settles = True

    def vehicle(self, index: int, command: str) -> None:
        self.log.append((index, command))
        if self.refuses(index, command):
            return
        if command == "ARM":
            self.view.armed[index] = self.view.mode[index] == "AUTO.TAKEOFF"
        elif command != "HOVER":
            self.view.mode[index] = command

    def leader(self, command: str) -> None:
        self.view.offsets = self.slots[command][::-1].astype(np.float32).astype(float)

    def leader_velocity(self, velocity: NDArray[np.float64]) -> None:
        self.velocity = velocity

    def event(self, event: str, **values: Any) -> None:
        self.events.append({"event": event, "time": self.view.time, **values})

    def move(self) -> None:
        view, z = self.view, self.view.position[:, 2]
        view.time += STEP
        for i in range(len(view.names)):
            if view.mode[i] == "AUTO.TAKEOFF" and view.armed[i]:
                z[i] += STEP
                if z[i] > 1.7:
                    view.mode[i] = "AUTO.LOITER"
            elif view.mode[i] == "AUTO.LAND" and view.armed[i]:
                z[i] = max(0.0, z[i] - STEP)
                view.armed[i] = z[i] > 0.0
        if view.mode[0] == "OFFBOARD":
            c, s = np.cos(view.leader_yaw), np.sin(view.leader_yaw)
            view.position[0] += STEP * (np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ self.velocity)
            if view.offsets is not None and self.settles:
                view.position[1:] += STEP * (view.position[0] + view.offsets - view.position[1:])

    def fly(self, limit: float = 400.0) -> None:
        for _ in self.mission.fly():
            self.move()
            assert self.view.time < limit


def test_whole_flight() -> None:
    fleet = PointFleet()
    fleet.view.leader_yaw = 0.7
    fleet.fly()
    phases = [e["phase"] for e in fleet.events if e["event"] == "phase"]
    assert phases == [
        "connect", "takeoff", "offboard", "pattern origin", "climb", "pattern cube", "move", "pattern pyramid",
        "move", "pattern triangle", "pattern origin", "descend", "land",
    ]  # fmt: skip
    assert fleet.mission.step == fleet.mission.steps == len(phases)
    assert fleet.mission.unsettled == []
    assert not any(fleet.view.armed)


def test_every_slot_is_clear_of_the_ground() -> None:
    fleet = PointFleet()
    lowest = np.inf
    for _ in fleet.mission.fly():
        fleet.move()
        if fleet.mission.phase in ("pattern cube", "pattern pyramid", "pattern triangle"):
            lowest = min(lowest, fleet.view.position[:, 2].min())
    assert fleet.mission.height == CLEARANCE + 4.0
    assert lowest > CLEARANCE - 0.2


def test_the_leader_moves_forward_between_patterns() -> None:
    fleet = PointFleet()
    fleet.view.leader_yaw = np.pi / 2
    fleet.fly()
    np.testing.assert_allclose(fleet.view.position[0, :2], [1.0, 2.0 + 8.0], atol=0.3)


def test_rejected_arming_is_repeated() -> None:
    fleet = PointFleet()
    fleet.refuses = lambda index, command: command == "ARM" and index == 2 and fleet.view.time < 5.0
    fleet.fly()
    assert fleet.log.count((2, "ARM")) > 3
    assert fleet.log.count((3, "ARM")) == 1


def test_a_vehicle_that_never_arms_is_reported() -> None:
    fleet = PointFleet()
    fleet.refuses = lambda index, command: command == "ARM" and index == 2
    with pytest.raises(MissionError, match=r"iris_2 \(disarmed, mode 'AUTO.TAKEOFF'\): did not arm within 40 s"):
        fleet.fly()
    for _ in fleet.mission.land():
        fleet.move()
    assert not any(fleet.view.armed)


def lost(fleet: PointFleet) -> list[tuple[str, str]]:
    return [(e["vehicle"], e["reason"]) for e in fleet.events if e["event"] == "lost"]


def test_the_flight_continues_without_a_follower_that_leaves_offboard() -> None:
    """The follower flies PX4's failsafe and the mission does not wait for it: it is still armed at the end."""
    fleet = PointFleet()
    fleet.refuses = lambda index, command: index == 4 and fleet.view.mode[4] == "POSCTL"
    for _ in fleet.mission.fly():
        place = fleet.view.position[4].copy()
        fleet.move()
        if fleet.mission.phase == "pattern cube" and fleet.view.mode[4] == "OFFBOARD":
            fleet.view.mode[4] = "POSCTL"
        if fleet.view.mode[4] == "POSCTL":
            fleet.view.position[4] = place
        assert fleet.view.time < 400.0
    assert lost(fleet) == [("iris_4", "is armed in mode 'POSCTL'; armed in OFFBOARD is needed")]
    assert fleet.mission.result == {"unsettled": [], "lost": ["iris_4"]}
    assert [i for i, armed in enumerate(fleet.view.armed) if armed] == [4]
    phases = [e["phase"] for e in fleet.events if e["event"] == "phase"]
    assert phases[-1] == "land"
    assert len(phases) == fleet.mission.steps


def test_a_follower_without_commands_is_lost_and_lands_with_the_others() -> None:
    fleet = PointFleet()
    told = 0.0
    for _ in fleet.mission.fly():
        place = fleet.view.position[2].copy()
        fleet.move()
        fleet.view.commanded = [None, *[fleet.view.time] * (COUNT - 1)]
        if fleet.mission.step >= 6:  # the first pattern after the climb
            told = told or fleet.view.time
            fleet.view.commanded[2] = told
            if fleet.mission.phase != "land":
                fleet.view.position[2] = place
        assert fleet.view.time < 400.0
    [(vehicle, reason)] = lost(fleet)
    assert (vehicle, reason) == ("iris_2", "no command of its follower for 5 s")
    [event] = [e for e in fleet.events if e["event"] == "lost"]
    assert 0.0 < event["time"] - told - COMMAND_LIMIT < 2.1 * STEP
    assert fleet.mission.unsettled == []
    assert not any(fleet.view.armed)


def test_a_leader_that_leaves_offboard_ends_the_flight_and_all_others_land() -> None:
    fleet = PointFleet()
    fleet.refuses = lambda index, command: index == 0 and fleet.view.mode[0] == "POSCTL"
    with pytest.raises(MissionError, match="leader iris_0: is armed in mode 'POSCTL'"):  # noqa: PT012
        for _ in fleet.mission.fly():
            fleet.move()
            if fleet.mission.phase == "move":
                fleet.view.mode[0] = "POSCTL"
    for _ in fleet.mission.land():
        fleet.move()
    assert [i for i, armed in enumerate(fleet.view.armed) if armed] == [0]


def test_a_leader_whose_node_has_stopped_ends_the_flight() -> None:
    fleet = PointFleet()
    with pytest.raises(MissionError, match="leader: its node has published no pattern for 5 s"):  # noqa: PT012
        for _ in fleet.mission.fly():
            fleet.move()
            if fleet.mission.step < 6:
                fleet.view.pattern_time = fleet.view.time
    assert fleet.mission.phase in ("pattern cube", "move")
    for _ in fleet.mission.land():
        fleet.move()
    assert not any(fleet.view.armed)


def test_a_flight_without_followers_ends() -> None:
    fleet = PointFleet(["cube"], 3)
    with pytest.raises(MissionError, match="no follower is left; the last, iris_2: is armed in mode"):  # noqa: PT012
        for _ in fleet.mission.fly():
            fleet.move()
            if fleet.mission.phase == "pattern cube":
                fleet.view.mode[1:] = ["AUTO.RTL"] * 2
    assert [vehicle for vehicle, _ in lost(fleet)] == ["iris_1", "iris_2"]


@pytest.mark.parametrize(
    ("deaf_to", "reason"),
    [
        ("OFFBOARD", "iris_3 (armed, mode 'AUTO.LOITER') did not switch to OFFBOARD within 15 s"),
        ("AUTO.LAND", "iris_3 (armed, mode 'OFFBOARD') did not land and disarm within 90 s"),
    ],
)
def test_a_follower_that_ignores_commands_in_flight_is_lost(deaf_to: str, reason: str) -> None:
    fleet = PointFleet()
    fleet.refuses = lambda index, command: index == 3 and command == deaf_to
    fleet.fly()
    assert lost(fleet) == [("iris_3", reason)]
    assert fleet.mission.result["lost"] == ["iris_3"]


def test_a_pattern_that_does_not_settle_is_noted() -> None:
    fleet = PointFleet(["cube"])
    for _ in fleet.mission.fly():
        fleet.settles = fleet.mission.phase != "pattern cube"
        fleet.move()
    assert fleet.mission.unsettled == ["cube"]
    event = next(e for e in fleet.events if e["event"] == "unsettled")
    assert event["vehicle"].startswith("iris_")
    assert event["error"] > 1.0


def test_a_leader_without_the_pattern_ends_the_flight() -> None:
    fleet = PointFleet()
    fleet.slots["cube"] = fleet.slots["cube"] + 1.0  # the mission expects other slots than the leader publishes
    fleet.leader = lambda command: setattr(fleet.view, "offsets", fleet.slots["origin"])  # type: ignore[method-assign]
    with pytest.raises(MissionError, match="no offsets of pattern 'cube' within 10 s"):
        fleet.fly()


def test_vehicles_that_never_connect_are_reported() -> None:
    fleet = PointFleet()
    fleet.view.connected[7] = False
    with pytest.raises(MissionError, match="iris_7"):
        fleet.fly()


def test_the_director_ignores_invalid_offsets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ignored are patterns of another size, and offsets that would put every vehicle into its slot."""
    pytest.importorskip("rospy")
    from std_msgs.msg import Float32MultiArray

    from xtdrone_interaction.missions.formation import director as module

    heard: dict[str, Callable[..., None]] = {}
    warnings: list[str] = []
    for name, value in (
        ("Publisher", lambda *_: None),
        ("Subscriber", lambda topic, kind, callback, *_: heard.setdefault(topic, callback)),
    ):
        monkeypatch.setattr(module.lockstep, name, value, raising=False)
    monkeypatch.setattr(module.rospy, "logwarn_once", warnings.append)
    monkeypatch.setattr(module.rospy, "get_time", lambda: 1.0)
    slots = swarm_patterns(3, ["cube"])
    director = module.FormationDirector(["iris_0", "iris_1", "iris_2"], ["cube"], slots, 3.0)
    hear = heard["/xtdrone/formation_pattern"]
    hear(Float32MultiArray(data=slots["cube"].T.ravel()))
    for data in ([1.0] * 7, [1.0] * 9, [np.nan] * 6, [np.inf, *[1.0] * 5]):
        hear(Float32MultiArray(data=data))
    assert director.view.offsets is not None
    assert director.view.offsets.tolist() == slots["cube"].tolist()
    assert len(warnings) == 4  # of which rospy logs one
    assert "7 values that are not 6 finite numbers; ignored" in warnings[0]
    hear(Float32MultiArray())  # pattern withdrawn
    assert director.view.error() is None
