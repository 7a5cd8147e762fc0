"""Leader and follower classes flying first- and second-order vehicles in one process, without ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.programs.user_classes import load_class
from xtdrone_coordination.follower import RATE, Follower, FollowerOptions, StarFollower
from xtdrone_coordination.known_swarm_state import SwarmState
from xtdrone_coordination.laws import formation_avoidance
from xtdrone_coordination.laws.consensus import Peer, Vector
from xtdrone_coordination.leader import Assignment, CommandError, Leader, LeaderOptions, assign, number_list
from xtdrone_coordination.patterns import PatternError, least_separation, with_leader

DT = 1.0 / RATE
EXAMPLES = Path(__file__).parents[1] / "examples"


class Swarm:
    """Point vehicles that follow commands exactly; vehicle 0 flies ``leader_velocity``."""

    def __init__(self, count: int, cls: type[Follower] = Follower, **options: object) -> None:
        self.state = SwarmState(count)
        self.warnings: list[str] = []
        self.leader = Leader(count, swarm=self.state, warn=self.warnings.append)
        settings = FollowerOptions(**options)  # type: ignore[arg-type]
        self.followers = [
            cls(i, count, swarm=self.state, options=settings, warn=self.warnings.append) for i in range(1, count)
        ]
        grid = self.leader.patterns.offsets("origin")
        self.x = with_leader(grid) + np.array([0.0, 0.0, 20.0])
        self.v = np.zeros((count, 3))
        self.leader_velocity = np.zeros(3)
        self.least = math.inf

    def hear(self) -> None:
        for j, (x, v) in enumerate(zip(self.x.tolist(), self.v.tolist(), strict=True)):
            self.state.on_position(j, tuple(x))
            self.state.on_velocity(j, tuple(v))

    def command(self, name: str) -> None:
        self.hear()
        assert self.leader.on_command(name) is None
        for follower in self.followers:
            follower.on_pattern(self.leader.offsets)
            follower.on_topology(self.leader.adjacency)
        self.least = math.inf

    def fly(self, seconds: float) -> None:
        pairs = np.triu_indices(len(self.x), 1)
        for _ in range(round(seconds * RATE)):
            self.hear()
            u = np.zeros_like(self.x)
            for follower in self.followers:
                u[follower.id] = follower.update()
            self.state.tick()
            self.v = self.v + DT * u if self.followers[0].options.mode == "accel" else u
            self.v[0] = self.leader_velocity
            self.x = self.x + DT * self.v
            self.least = min(self.least, np.linalg.norm(self.x[:, None] - self.x[None], axis=-1)[pairs].min())

    @property
    def error(self) -> float:
        return float(np.linalg.norm(self.x[1:] - self.x[0] - self.leader.offsets, axis=1).max())


def test_nine_change_from_origin_to_cube_pyramid_and_triangle() -> None:
    swarm = Swarm(9)
    for name in ("cube", "pyramid", "triangle"):
        swarm.command(name)
        distance = np.linalg.norm(swarm.x[1:] - swarm.x[0] - swarm.leader.offsets, axis=1).sum()
        assert distance == pytest.approx(swarm.leader.distance)
        swarm.fly(15.0)
        assert swarm.error < 0.05, name
        assert swarm.least > 1.0, name
    assert not swarm.warnings


def test_other_sizes_keep_their_distance() -> None:
    for count, names in ((2, ("cube", "triangle")), (6, ("T", "diamond")), (12, ("pyramid", "triangle"))):
        swarm = Swarm(count)
        for name in names:
            swarm.command(name)
            swarm.fly(18.0)
            assert swarm.error < 0.05, (count, name)
            assert swarm.least > 0.7, (count, name)


def test_acceleration_form_settles() -> None:
    swarm = Swarm(6, mode="accel")
    swarm.command("T")
    swarm.fly(30.0)
    assert swarm.error < 0.05
    assert swarm.least > 0.7


def test_plain_follower_lags_behind_a_moving_leader_by_v_over_gain() -> None:
    swarm = Swarm(2)
    swarm.command("cube")
    swarm.fly(10.0)
    swarm.leader_velocity = np.array([-0.5, 0.0, 0.0])
    swarm.fly(10.0)
    assert swarm.error == pytest.approx(0.5 / 1.0, rel=0.05)


def test_speed_is_limited_continuously() -> None:
    swarm = Swarm(2)
    swarm.command("cube")
    for distance, speed in ((0.5, 0.5), (0.99, 0.99), (1.5, 1.0), (9.0, 1.0)):
        swarm.x[1] = swarm.x[0] + swarm.leader.offsets[0] + [distance, 0.0, 0.0]
        swarm.hear()
        assert np.linalg.norm(swarm.followers[0].update()) == pytest.approx(speed, rel=1e-6)


def test_overriding_needs_a_few_lines() -> None:
    class LeaderKeepsNumbers(Leader):
        def assignment(self, current: np.ndarray, target: np.ndarray) -> Assignment:
            return Assignment(np.arange(len(target)), 0.0)

        def topology(self, offsets: np.ndarray) -> np.ndarray:
            return np.zeros((len(offsets),) * 2)

    leader = LeaderKeepsNumbers(9)
    leader.on_command("cube")
    assert leader.offsets.tolist() == leader.patterns.offsets("cube").tolist()
    assert leader.adjacency[:, 0].tolist() == [0] + [1] * 8

    class Upwards(Follower):
        def avoidance(self) -> list[float]:  # type: ignore[override]
            return [0.0, 0.0, 0.25]

        def neighbours(self) -> Mapping[int, float]:
            return {0: 1.0}

    swarm = Swarm(2, Upwards)
    swarm.command("cube")
    swarm.x[1] = swarm.x[0] + swarm.leader.offsets[0]
    swarm.hear()
    assert swarm.followers[0].update() == pytest.approx((0.0, 0.0, 0.25))


def test_star_follower_listens_to_the_leader_alone() -> None:
    swarm = Swarm(9, StarFollower, avoid="off")
    swarm.command("cube")
    swarm.x[2] = (50.0, 50.0, 50.0)
    before = [f.update() for f in swarm.followers if f.id != 2]
    swarm.hear()
    assert [f.update() for f in swarm.followers if f.id != 2] == before


@pytest.mark.parametrize("method", ["control_law", "avoidance"])
@pytest.mark.parametrize("value", [(math.nan, 0.0, 0.0), (1.0, 2.0), None, "up"])
def test_bad_results_of_overridden_methods_stop_the_vehicle_not_the_node(method: str, value: object) -> None:
    swarm = Swarm(2)
    swarm.command("cube")
    swarm.x[1] = swarm.x[0] + swarm.leader.offsets[0]
    swarm.hear()
    setattr(swarm.followers[0], method, lambda *args: value)
    for _ in range(3):
        assert swarm.followers[0].update() == pytest.approx((0.0, 0.0, 0.0))
    assert len(swarm.warnings) == 1
    assert method in swarm.warnings[0]


def follower_alone(**options: object) -> tuple[Follower, list[str]]:
    warnings: list[str] = []
    settings = FollowerOptions(**options)  # type: ignore[arg-type]
    return Follower(1, 3, options=settings, warn=warnings.append), warnings


OFFSETS = [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]]


def test_says_nothing_before_pattern_and_position() -> None:
    follower, _ = follower_alone()
    assert follower.update() is None
    follower.on_pattern(OFFSETS)
    assert follower.update() is None
    follower.swarm.on_position(1, (0.0, 0.0, 0.0))
    assert follower.update() == (0.0, 0.0, 0.0), "the leader is not known yet"
    follower.swarm.on_position(0, (-2.0, 0.0, 0.0))
    assert follower.update() == pytest.approx((1.0, 0.0, 0.0))


@pytest.mark.parametrize("silent", [0, 1])
def test_stands_still_when_positions_stop(silent: int) -> None:
    follower, warnings = follower_alone(pose_timeout=1.0)
    follower.on_pattern(OFFSETS)
    follower.swarm.on_position(silent, (-3.0, 0.0, 0.0))
    for _ in range(2 * RATE):
        follower.swarm.on_position(1 - silent, (3.0, 0.0, 0.0))
        last = follower.update()
        follower.swarm.tick()
    assert last == (0.0, 0.0, 0.0)
    assert len(warnings) == 1
    assert "position" in warnings[0]
    follower.swarm.on_position(silent, (-3.0, 0.0, 0.0))
    assert follower.update() != (0.0, 0.0, 0.0), "and goes on when they come again"


def test_a_position_that_is_not_finite_is_not_used() -> None:
    state = SwarmState(2)
    state.on_position(0, (1.0, 2.0, 3.0))
    state.on_position(0, (math.nan, 2.0, 3.0))
    assert state.positions[0] == (1.0, 2.0, 3.0)


def test_avoidance_may_be_external_or_absent() -> None:
    at = [(0.0, 0.0, 0.0), (5.0, 0.5, 0.0), (5.0, 0.0, 0.0)]
    moves = {}
    for avoid in ("own", "topic", "off"):
        follower, _ = follower_alone(avoid=avoid, clearance=0.0, vel_max=9.0)
        follower.on_pattern(OFFSETS)
        for j, p in enumerate(at):
            follower.swarm.on_position(j, p)
        follower.on_avoidance((0.0, 0.0, 0.5))
        moves[avoid] = follower.update()
    assert moves["off"] == pytest.approx((0.0, -0.5, 0.0))
    assert moves["topic"] == pytest.approx((0.0, -0.5, 0.5))
    assert abs(moves["own"][2]) == pytest.approx(1 - 0.5 / 1.5)


def test_own_avoidance_replaces_a_silent_one_until_it_returns() -> None:
    """The timeout counts ticks, like the age of positions."""
    follower, warnings = follower_alone(avoid="topic", clearance=0.0, vel_max=9.0, pose_timeout=0.1)
    own, _ = follower_alone(avoid="own", clearance=0.0, vel_max=9.0)
    news: list[str] = []
    follower.info = news.append
    for one in (follower, own):
        one.on_pattern(OFFSETS)

    def turn(heard: tuple[float, float, float] | None) -> bool:
        """Return whether the follower uses the avoidance that it received."""
        for one in (follower, own):
            for j, p in enumerate([(0.0, 0.0, 0.0), (5.0, 0.5, 0.0), (5.0, 0.0, 0.0)]):
                one.swarm.on_position(j, p)
        if heard is not None:
            follower.on_avoidance(heard)
        used, alone = follower.update(), own.update()
        assert (follower.avoidance_vector == (0.0, 0.0, 0.5)) != (used == alone)
        follower.swarm.tick()
        own.swarm.tick()
        return used != alone

    told = (0.0, 0.0, 0.5)
    assert turn(told)
    assert [turn(None) for _ in range(3 + 4)] == [True] * 3 + [False] * 4  # 0.1 s are 3 ticks
    assert [turn((math.nan, 0.0, 0.0)), turn((0.0, math.inf, 0.0))] == [False, False]  # as if they had not arrived
    assert warnings == ["follower 1: no avoidance on its topic within 0.1 s: using its own until one is received"]
    assert not news
    assert [turn(told), turn(None)] == [True, True]
    assert news == ["follower 1: avoidance on its topic again: using it"]
    assert len(warnings) == 1


def test_an_avoidance_that_never_came_is_replaced_by_the_own_one() -> None:
    follower, warnings = follower_alone(avoid="topic")
    follower.on_pattern(OFFSETS)
    for j, p in enumerate([(0.0, 0.0, 0.0), (5.0, 0.5, 0.0), (5.0, 0.0, 0.0)]):
        follower.swarm.on_position(j, p)
    follower.update()
    assert follower.avoidance_vector == formation_avoidance.avoid(1, follower.swarm.positions)
    assert len(warnings) == 1


def test_an_update_searches_for_near_vehicles_once_and_keeps_none_for_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    follower, _ = follower_alone(avoid="own", clearance=0.7, vel_max=9.0)
    follower.on_pattern(OFFSETS)
    searches: list[float] = []
    search = formation_avoidance.near_vehicles

    def counted(index: int, positions: Sequence[Vector | None], radius: float) -> formation_avoidance.Near:
        searches.append(radius)
        return search(index, positions, radius)

    monkeypatch.setattr(formation_avoidance, "near_vehicles", counted)
    for distance in (0.5, 1.2, 4.0):
        for j, p in enumerate([(0.0, 0.0, 0.0), (5.0, distance, 0.0), (5.0, 0.0, 0.0)]):
            follower.swarm.on_position(j, p)
        searches.clear()
        follower.update()
        assert len(searches) == 1
        expected = formation_avoidance.avoid(1, follower.swarm.positions)
        assert follower.avoidance_vector == follower.avoidance() == expected


@pytest.mark.parametrize(("avoid", "remains"), [("own", 0.0), ("topic", 0.0), ("off", 0.5)])
def test_gives_way_with_every_source_of_the_avoidance(avoid: str, remains: float) -> None:
    follower, _ = follower_alone(avoid=avoid, clearance=0.7, vel_max=9.0)
    follower.on_pattern(OFFSETS)
    for j, p in enumerate([(0.0, 0.0, 0.0), (5.0, 0.5, 0.0), (5.0, 0.0, 0.0)]):
        follower.swarm.on_position(j, p)
    assert follower.update()[1] == pytest.approx(-remains, abs=1e-12)


@pytest.mark.parametrize(
    "bad",
    [{"Kp": 0.0}, {"Kp": math.nan}, {"mode": "position"}, {"avoid": "yes"}, {"vel_max": "fast"}, {"clearance": 2}],
)
def test_invalid_settings_are_reported(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        FollowerOptions(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("id", [0, 9, -1])
def test_follower_ids(id: int) -> None:
    with pytest.raises(ValueError, match="1 to 8"):
        Follower(id, 9)


def test_wrong_sizes_are_rejected_by_followers() -> None:
    follower, _ = follower_alone()
    with pytest.raises(PatternError, match="2 x 3"):
        follower.on_pattern([[1, 2, 3]])
    with pytest.raises(ValueError, match="3 x 3"):
        follower.on_topology([0, 1])


# the leader


def test_leader_passes_flight_commands_and_ignores_the_keyboards_idling() -> None:
    leader = Leader(9)
    for text in ("ARM", "OFFBOARD", "AUTO.LAND", "HOVER", "AUTO.PRECLAND", "mission1"):
        assert leader.on_command(text) == text
    for text in ("", "stop controlling", "waiting"):
        assert leader.on_command(text) is None
    assert leader.pattern == ""


def test_leader_rejects_unknown_patterns_and_lists_the_known() -> None:
    with pytest.raises(CommandError, match=r"'cuboid'.*origin, cube, pyramid, triangle, .*text:WORDS"):
        Leader(9).on_command("cuboid")


def test_leader_accepts_shapes_with_arguments_as_commands() -> None:
    leader = Leader(9)
    assert leader.on_command("text:XTD:spacing=2.5") is None
    assert leader.pattern == "text:XTD:spacing=2.5"
    assert leader.offsets is not None
    for text, message in (
        ("text", "leader: pattern 'text': text needs WORDS"),
        ("circle:spacing=0", "leader: pattern 'circle:spacing=0': spacing: '0' is not allowed"),
        ("cloud:/nowhere.xyz", "leader: pattern 'cloud:/nowhere.xyz': cloud /nowhere.xyz: No such file"),
    ):
        with pytest.raises(CommandError, match=message):
            leader.on_command(text)
    assert leader.pattern == "text:XTD:spacing=2.5", "the old pattern stays"


def test_vehicles_without_a_path_to_the_leader_are_reported() -> None:
    class Halves(Leader):
        """The upper half of the vehicles listens in a circle."""

        def topology(self, offsets: np.ndarray) -> np.ndarray:
            half = self.count // 2
            listens = np.eye(self.count, k=-1, dtype=int)
            listens[half, half - 1], listens[half, self.count - 1] = 0, 1
            return listens

    said: list[str] = []
    Halves(300, warn=said.append).choose("sphere")
    assert len(said) == 1
    assert "topology of pattern 'sphere' cuts off 150-299 of 300 vehicles" in said[0]
    said.clear()
    Leader(300, warn=said.append).choose("sphere")
    assert said == []


def test_vehicles_without_neighbours_are_reported() -> None:
    class Deaf(Leader):
        def topology(self, offsets: np.ndarray) -> np.ndarray:
            listens = np.eye(self.count, k=-1, dtype=int)
            listens[[3, 5, 6]] = 0
            return listens

    said: list[str] = []
    leader = Deaf(9, warn=said.append)
    leader.choose("cube")
    assert said == ["leader: topology of pattern 'cube' has no neighbours for 3, 5-6 of 9 vehicles: vehicle 0 is added"]
    assert leader.adjacency is not None
    assert np.flatnonzero(leader.adjacency[5]).tolist() == [0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (0.5 * np.eye(9, k=-1), "weight of 0.5; weights travel as whole numbers, 0 to 2147483647"),
        (2.0**31 * np.eye(9, k=-1), r"weight of 2\.14748e\+09"),
        ([[0], [1, 0]], "overridden topology"),
        (None, "overridden topology"),
        ("abc", "overridden topology"),
    ],
)
def test_topologies_that_cannot_be_sent_are_rejected(given: object, message: str) -> None:
    class Strange(Leader):
        def topology(self, offsets: np.ndarray) -> object:  # type: ignore[override]
            return given

    with pytest.raises(CommandError, match=message):
        Strange(9).choose("cube")


@pytest.mark.parametrize(
    "given", [None, "slots", [0, 1, 2], [0.5, *range(1, 8)], [0, 0, *range(2, 8)], list(range(1, 9)), [math.nan] * 8]
)
def test_an_invalid_assignment_is_rejected(given: object) -> None:
    class Strange(Leader):
        def assignment(self, current: np.ndarray, target: np.ndarray) -> object:  # type: ignore[override]
            return given

    with pytest.raises(CommandError, match="which is not a permutation of the slots 0 to 7"):
        Strange(9).choose("cube")


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_a_plain_permutation_is_an_assignment(kind: Callable[..., object]) -> None:
    class Reversed(Leader):
        def assignment(self, current: np.ndarray, target: np.ndarray) -> object:  # type: ignore[override]
            return kind(range(7, -1, -1))

    leader = Reversed(9)
    current, target = leader.current(), leader.patterns.offsets("cube")
    leader.choose("cube")
    np.testing.assert_array_equal(leader.offsets, target[::-1])
    assert leader.distance == pytest.approx(np.linalg.norm(current - target[::-1], axis=1).sum())


def test_the_example_leader_assigns_the_nearest_first() -> None:
    example = load_class(str(EXAMPLES / "nearest_first_leader.py"), Leader)
    leader = example(4)
    current, target = np.zeros((2, 3, 3))
    current[:, 0], target[:, 0] = (0.0, 3.0, 9.0), (2.0, 8.0, 4.5)
    assert np.asarray(leader.assignment(current, target)).tolist() == [2, 0, 1]


def test_the_example_with_an_integral_removes_the_error_of_a_disturbance() -> None:
    errors = {}
    for cls in (Follower, load_class(str(EXAMPLES / "integral_follower.py"), Follower)):
        swarm = Swarm(2, cls)
        swarm.command("origin")
        for _ in range(60):
            swarm.fly(1.0)
            swarm.x[1] += (0.05, 0.0, 0.0)  # as wind would
        swarm.hear()
        errors[cls.__name__] = np.linalg.norm(swarm.x[1] - swarm.x[0] - swarm.leader.offsets[0])
    assert errors["Follower"] > 0.04
    assert errors["IntegralFollower"] < 0.6 * errors["Follower"]


def test_time_counts_turns_without_drift_and_starts_again() -> None:
    seen: list[tuple[float, float]] = []

    class Clocked(Follower):
        def control_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
            seen.append((self.time, self.dt))
            return super().control_law(position, peers)

    swarm = Swarm(3, Clocked)
    swarm.command("triangle")
    swarm.fly(2.0)
    times = sorted({time for time, _ in seen})
    assert {dt for _, dt in seen} == {1.0 / RATE}
    first = round(times[0] * RATE)
    assert times == [(first + k) / RATE for k in range(len(times))]
    assert len(times) >= 59
    assert swarm.leader.time == (first + len(times)) / RATE
    seen.clear()
    swarm.leader.restart()
    for follower in swarm.followers:
        follower.restart()
    assert [follower.time for follower in swarm.followers] == [0.0, 0.0]
    assert swarm.leader.time == 0.0


def test_long_lists_of_numbers_are_abbreviated() -> None:
    assert number_list([4]) == "4"
    assert number_list([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
    assert number_list(list(range(1, 1000, 2))) == "1, 3, 5, 7, 9, 11, 13, 15, ... (500 in total)"


def test_a_thousand_vehicles_are_led() -> None:
    leader = Leader(1000)
    start = time.process_time()
    leader.choose("sphere")
    leader.choose("text:XTD")
    assert time.process_time() - start < 20.0, "a bound on what is broken, no benchmark"
    assert leader.offsets is not None
    assert least_separation(leader.offsets) == pytest.approx(2.0)


def test_a_wrong_permutation_of_many_is_abbreviated() -> None:
    class Broken(Leader):
        def assignment(self, current: np.ndarray, target: np.ndarray) -> Assignment:
            return Assignment(np.zeros(len(target), dtype=np.intp), 0.0)

    with pytest.raises(CommandError, match="which is not a permutation") as raised:
        Broken(1000).choose("grid")
    assert len(str(raised.value)) < 200


def test_leader_does_not_assign_anew_for_a_repeated_name() -> None:
    swarm = Swarm(9)
    swarm.command("cube")
    offsets = swarm.leader.offsets
    swarm.fly(2.0)
    swarm.hear()
    swarm.leader.on_command("cube")
    assert swarm.leader.offsets is offsets


def test_leader_assigns_from_offsets_while_positions_are_unknown() -> None:
    leader = Leader(9)
    leader.on_command("pyramid")
    pyramid = leader.offsets
    leader.on_command("cube")
    assert leader.distance == pytest.approx(assign(pyramid, leader.patterns.offsets("cube")).cost)


def test_leader_rejects_a_pattern_that_reaches_into_the_ground() -> None:
    leader = Leader(9)
    leader.swarm.on_position(0, (0.0, 0.0, 3.0))
    with pytest.raises(CommandError, match=r"climb to 4\.5 m"):
        leader.on_command("triangle")
    leader.on_command("origin")
    assert leader.pattern == "origin"


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("assignment", lambda current, target: Assignment(np.zeros(8, dtype=int), 0.0)),
        ("topology", lambda offsets: np.ones((9, 9))),
    ],
)
def test_leader_names_the_overridden_method_that_is_wrong(name: str, method: Callable[..., object]) -> None:
    leader = Leader(9)
    setattr(leader, name, method)
    with pytest.raises(CommandError, match=name):
        leader.on_command("cube")
    assert leader.pattern == ""


def test_steering_goes_out_once() -> None:
    leader = Leader(9)
    assert leader.update() is None
    leader.on_steering((1.0, 0.0, 0.0), 0.1)
    assert leader.update() == ((1.0, 0.0, 0.0), 0.1)
    assert leader.update() is None


def test_leader_can_avoid_too() -> None:
    leader = Leader(2, options=LeaderOptions(avoid="own"))
    leader.yaw = math.pi / 2
    leader.swarm.on_position(0, (0.0, 0.0, 0.0))
    leader.swarm.on_position(1, (0.0, 0.0, 0.75))  # above: dodge towards west, which is to the left
    (x, y, z), _ = leader.update()
    assert (x, y, z) == pytest.approx((0.0, 0.5, 0.0))
    leader.swarm.on_position(1, (9.0, 0.0, 0.0))
    assert leader.update() == ((0.0, 0.0, 0.0), 0.0)
    assert leader.update() is None


def test_close_slots_are_warned_of() -> None:
    warnings: list[str] = []

    class Near(Leader):
        def topology(self, offsets: np.ndarray) -> Sequence[Sequence[int]]:
            return [[0, 0], [1, 0]]

    leader = Near(2, warn=warnings.append)
    leader.patterns._tables["near"] = np.array([[0.0, 1.0, 0.0]])
    leader.on_command("near")
    assert "1.00 m apart" in warnings[0]


def state_of(thing: object) -> dict[str, object]:
    """Return an object's attributes; arrays and other objects as text."""
    return {
        name: state_of(value) if isinstance(value, SwarmState) else repr(value) for name, value in vars(thing).items()
    }


def test_a_restart_brings_back_the_state_after_construction() -> None:
    swarm = Swarm(4, avoid="topic")
    members = [swarm.leader, *swarm.followers]
    for one in members:
        one._warn = print  # both warnings have the same text
    before = [state_of(one) for one in members]
    positions = swarm.state.positions
    swarm.command("cube")
    swarm.leader.on_steering((1.0, 0.0, 0.0), 0.1)
    swarm.leader.yaw = 1.0
    swarm.followers[0].on_avoidance((1.0, 0.0, 0.0))
    swarm.fly(1.0)
    swarm.leader.update()
    swarm.state.on_position(1, (9.0, 9.0, 9.0))
    changed = [state_of(one) for one in members]
    assert all(a != b for a, b in zip(before, changed, strict=True))
    for one in members:
        one.restart()
    assert [state_of(one) for one in members] == before
    assert swarm.state.positions is positions  # a holder of the list sees the change


def test_a_subclass_resets_its_own_attributes() -> None:
    class Counting(Follower):
        def __init__(self, *args: object, **kwargs: object) -> None:
            super().__init__(*args, **kwargs)  # type: ignore[arg-type]
            self.calls = 0

        def restart(self) -> None:
            super().restart()
            self.calls = 0

    follower = Counting(1, 2)
    follower.calls = 3
    follower.on_pattern([[3.0, 0.0, 0.0]])
    follower.restart()
    assert (follower.calls, follower.offsets) == (0, None)
