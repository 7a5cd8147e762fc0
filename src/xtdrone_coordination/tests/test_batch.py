"""A batch of followers equals its followers run one by one, to the last bit, and logs the same messages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_common.programs.user_classes import load_class
from xtdrone_coordination.array_follower import ArrayFollower, OwnRows, PeerRows
from xtdrone_coordination.batch import FollowerBatch
from xtdrone_coordination.follower import RATE, Follower, FollowerOptions, StarFollower
from xtdrone_coordination.known_swarm_state import ArraySwarm, SwarmState
from xtdrone_coordination.laws.consensus import Peer, Vector
from xtdrone_coordination.patterns import PatternError, Patterns

UNKNOWN = np.full(3, math.nan)


class FeedForward(Follower):
    def control_law(self, position: Vector, peers: Sequence[Peer]) -> list[float]:  # type: ignore[override]
        stock = super().control_law(position, peers)
        return [u + sum(peer.velocity[axis] for peer in peers) / len(peers) for axis, u in enumerate(stock)]


class Wayward(Follower):
    """Returns unusable values now and then."""

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        return (math.nan, 0.0, 0.0) if position[0] > 1.0 else (0.1, 0.2, -0.3)


class Upwards(Follower):
    def avoidance(self) -> np.ndarray:  # type: ignore[override]
        return np.array([0.0, 0.0, 0.25]) + np.array(super().avoidance())


class HearsTheNearest(Follower):
    def neighbours(self) -> Mapping[int, float]:
        own = self.swarm.positions[self.id]
        assert own is not None
        others = {j: p for j, p in enumerate(self.swarm.positions) if p is not None and j != self.id}
        return {j: 1.0 + j for j in sorted(others, key=lambda j: math.dist(others[j], own))[:3]}


class Smooth(Follower):
    """Remembers its last command."""

    def __init__(self, *args: object, **named: object) -> None:
        super().__init__(*args, **named)  # type: ignore[arg-type]
        self.last = np.zeros(3)

    def restart(self) -> None:
        super().restart()
        self.last = np.zeros(3)

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> np.ndarray:  # type: ignore[override]
        self.last = 0.8 * self.last + 0.2 * np.array(super().control_law(position, peers))
        return self.last + 0.1 * np.array(self.avoidance_vector)


class Adaptive(Follower):
    """Changes its own options within its law, which takes effect at once."""

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        east = position[0] > 0.5
        self.options = replace(
            self.options,
            Kp=0.5 if east else 2.0,
            vel_max=0.4 if east else 3.0,
            avoid="own" if position[1] > 0.0 else "off",
            avoid_radius=4.0 if east else 1.6,
            pose_timeout=0.1 if east else 0.2,
        )
        return super().control_law(position, peers)


class Everything(FeedForward, Upwards, HearsTheNearest):
    pass


class Halved(Follower):
    def update(self) -> Vector | None:
        command = super().update()
        return None if command is None else (command[0] / 2, command[1] / 2, command[2] / 2)


class Unlimited(Follower):
    def _limited(self, wanted: Vector) -> Vector:
        return wanted


class InArrays(ArrayFollower):
    """Its law reads all available inputs."""

    @classmethod
    def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> np.ndarray:
        pull = peers.weight[:, None] * (peers.position - peers.offset - (own.position - own.offset)[peers.row])
        away = peers.mean(peers.velocity) - own.velocity
        return 0.5 * own.stock + options.Kp * peers.sum(pull) + 0.1 * away + 1e-3 * own.ids[:, None]


class InBothForms(FeedForward, ArrayFollower):
    @classmethod
    def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> np.ndarray:
        return own.stock + peers.mean(peers.velocity)

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> list[float]:  # type: ignore[override]
        return super().control_law(position, peers)


class BackToOne(InArrays):
    """The law for one follower overrides the law for arrays of its base class."""

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        return 0.1, 0.2, 0.3


class SeesUpwards(InArrays, Upwards, HearsTheNearest):
    pass


class WaywardInArrays(ArrayFollower):
    @classmethod
    def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> np.ndarray:
        return np.where(own.position > 1.0, math.nan, own.stock)


class Useless(ArrayFollower):
    @classmethod
    def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> str:
        return "up"


CLASSES = [
    Follower,
    StarFollower,
    FeedForward,
    Wayward,
    Upwards,
    HearsTheNearest,
    Smooth,
    Adaptive,
    Everything,
    Halved,
    Unlimited,
    InArrays,
    InBothForms,
    BackToOne,
    SeesUpwards,
    WaywardInArrays,
    Useless,
]


class Twins:
    """The same followers twice: one by one on a plain state, and as a batch."""

    def __init__(self, count: int, classes: Sequence[type[Follower]], options: Sequence[FollowerOptions]) -> None:
        self.plain, self.arrays = SwarmState(count), ArraySwarm(count)
        self.said: tuple[list[str], list[str]] = ([], [])
        self.single, self.batched = (
            [
                classes[i % len(classes)](i, count, swarm=swarm, options=options[i % len(options)], warn=said.append)
                for i in range(1, count)
            ]
            for swarm, said in zip((self.plain, self.arrays), self.said, strict=True)
        )
        for followers, said in zip((self.single, self.batched), self.said, strict=True):
            for follower in followers:
                follower.info = said.append
        self.batch = FollowerBatch(self.batched, self.arrays)

    def hear(self, positions: np.ndarray, velocities: np.ndarray) -> None:
        self.arrays.hear(positions, velocities)
        for j, (x, v) in enumerate(zip(positions.tolist(), velocities.tolist(), strict=True)):
            self.plain.on_position(j, tuple(x))
            self.plain.on_velocity(j, tuple(v))

    def avoidance(self, vectors: np.ndarray) -> None:
        """Pass each follower its row; a non-finite row is a missing message."""
        for followers in (self.single, self.batched):
            for follower in followers:
                follower.on_avoidance(tuple(vectors[follower.id].tolist()))

    def pattern(self, offsets: np.ndarray) -> None:
        self.batch.on_pattern(offsets)
        for follower in self.single:
            follower.on_pattern(offsets)

    def topology(self, adjacency: np.ndarray) -> None:
        self.batch.on_topology(adjacency)
        for follower in self.single:
            follower.on_topology(adjacency)

    def restart(self) -> None:
        self.batch.restart()
        for follower in self.single:
            follower.restart()

    def turn(self) -> np.ndarray:
        """Compute one turn both ways, compare, and return the commands."""
        wanted = [follower.update() for follower in self.single]
        commands, given = self.batch.update()
        assert not given[0]
        assert given[1:].tolist() == [u is not None for u in wanted]
        assert bits(commands[1:]) == bits([u or (0.0, 0.0, 0.0) for u in wanted])
        assert bits([f.avoidance_vector for f in self.batched]) == bits([f.avoidance_vector for f in self.single])
        assert sorted(self.said[1]) == sorted(self.said[0])
        self.plain.tick()
        self.arrays.tick()
        return commands.copy()


def bits(vectors: object) -> list[str]:
    """Return numbers in a form that compares exactly, the sign of zero included."""
    return [number.hex() for number in np.asarray(vectors, dtype=float).ravel().tolist()]


def fly(twins: Twins, seed: int, turns: int, *, box: float, losses: float, dt: float = 1.0 / RATE) -> None:
    """Fly from random positions in a box (m) with lost states, changes of topology and pattern, and a restart."""
    rng = np.random.default_rng(seed)
    count = twins.plain.count
    accel = twins.single[0].options.mode == "accel"
    x, v = rng.uniform(-box, box, (count, 3)), rng.normal(size=(count, 3))
    x[rng.integers(count)] = x[rng.integers(count)]  # possibly at one position
    for k in range(turns):
        if k % 50 == 1:
            offsets = Patterns(count).offsets(("cube", "triangle", "pyramid", "origin")[k // 50 % 4])
            twins.pattern(offsets[rng.permutation(count - 1)])
        if k % 40 == 10:
            linked = rng.random((count, count)) < min(1.0, 4.0 / count)
            twins.topology(np.where(linked & ~np.eye(count, dtype=bool), rng.uniform(0.1, 2.0, (count, count)), 0.0))
        if k == turns * 2 // 3:
            twins.restart()
        silent = rng.random(count) < losses
        twins.hear(np.where(silent[:, None], UNKNOWN, x), np.where(rng.random((count, 1)) < losses, UNKNOWN, v))
        avoidance_silent = (k // 9 % 2 == 1) | (rng.random(count) < losses)  # its node may be dead for a while
        twins.avoidance(np.where(avoidance_silent[:, None], UNKNOWN, rng.normal(size=(count, 3))))
        u = twins.turn()
        v = v + dt * u if accel else u
        x = x + dt * v
        x[0] += (0.02, 0.01, 0.0)


options_of_followers = st.builds(
    FollowerOptions,
    mode=st.sampled_from(["vel", "accel"]),
    Kp=st.sampled_from([1, 0.7, 3.0]),
    raw_weights=st.booleans(),
    vel_max=st.sampled_from([1.0, 5.0]),
    accel_max=st.sampled_from([1.0, 2.0]),
    avoid=st.sampled_from(["own", "own", "topic", "off"]),
    Kp_avoid=st.sampled_from([0.0, 1.0, 2.5]),
    avoid_radius=st.sampled_from([1.5, 3.0]),
    clearance=st.sampled_from([0.0, 0.7, 1.4]),
    pose_timeout=st.sampled_from([0.03, 0.1, 1.0]),
)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    count=st.integers(2, 40),
    seed=st.integers(0, 2**31),
    box=st.sampled_from([0.5, 3.0, 30.0]),
    losses=st.sampled_from([0.0, 0.1, 0.7]),
    options=st.lists(options_of_followers, min_size=1, max_size=3),
    classes=st.one_of(st.just([Follower]), st.lists(st.sampled_from(CLASSES), min_size=1, max_size=4)),
)
def test_short_flights_of_any_kind(
    count: int,
    seed: int,
    box: float,
    losses: float,
    options: list[FollowerOptions],
    classes: list[type[Follower]],
) -> None:
    fly(Twins(count, classes, options), seed, 25, box=box, losses=losses)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data(), count=st.integers(2, 30), options=options_of_followers)
def test_places_that_are_hard(data: st.DataObject, count: int, options: FollowerOptions) -> None:
    """Both agree on coincident vehicles, and on vehicles exactly at the radius, far away, and at unknown positions."""
    number = st.one_of(
        st.sampled_from([0.0, -0.0, 1.5, -1.5, 1e-7, 0.7, 3.0, 1e9, -1e200, 1.7e308]), st.floats(-5.0, 5.0)
    )
    place = st.one_of(st.just((math.nan, 0.0, 0.0)), st.just((0.0, 0.0, 0.0)), st.tuples(number, number, number))
    twins = Twins(count, [Follower], [options])
    twins.pattern(Patterns(count).offsets("origin"))
    for _ in range(2):
        places = np.array(data.draw(st.lists(place, min_size=count, max_size=count)))
        twins.hear(places, 0.3 * places)
        twins.turn()


@pytest.mark.parametrize("mode", ["vel", "accel"])
def test_a_long_flight_of_nine(mode: str) -> None:
    options = FollowerOptions(mode=mode, pose_timeout=0.1)  # type: ignore[arg-type]
    fly(Twins(9, [Follower], [options]), 1, 1500, box=6.0, losses=0.2)


@pytest.mark.parametrize("box", [2.0, 12.0])
def test_a_flight_of_two_hundred_and_fifty(box: float) -> None:
    """Batch and single followers agree with all vehicles close to each other, and spread over the cells."""
    fly(Twins(250, [Follower], [FollowerOptions(pose_timeout=0.1)]), 2, 24, box=box, losses=0.1)


@pytest.mark.parametrize("cls", CLASSES)
def test_each_class_by_itself(cls: type[Follower]) -> None:
    fly(Twins(12, [cls], [FollowerOptions(pose_timeout=0.1)]), 3, 130, box=3.0, losses=0.3)


def test_the_example_agrees_with_itself() -> None:
    example = load_class(str(Path(__file__).parents[1] / "examples" / "feed_forward_follower.py"), Follower)
    assert issubclass(example, ArrayFollower)
    fly(Twins(12, [example], [FollowerOptions(pose_timeout=0.1)]), 3, 130, box=3.0, losses=0.3)


def test_a_law_in_arrays_needs_its_base_class() -> None:
    class Lost(Follower):
        @classmethod
        def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> np.ndarray:
            return own.stock

    with pytest.raises(TypeError, match=r"class Lost .* inherit xtdrone_coordination\.array_follower\.ArrayFollower"):
        Lost(1, 3)


def test_a_law_in_arrays_of_the_wrong_shape_stops_the_vehicle_not_the_swarm() -> None:
    class TooFew(ArrayFollower):
        @classmethod
        def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> np.ndarray:
            return own.stock[:, :2]

    twins = Twins(3, [TooFew], [FollowerOptions()])
    twins.pattern(Patterns(3).offsets("cube"))
    for followers in (twins.single, twins.batched):
        for follower in followers:
            follower.warn = lambda text: None  # it logs the given values, here of one follower and there of all
    twins.hear(9.0 * np.eye(3), np.zeros((3, 3)))
    assert not twins.turn().any()
    assert all("control_laws returned" in text for follower in twins.batched for text in follower.problem_log.current)


def test_received_avoidance_velocities_are_used() -> None:
    twins = Twins(3, [Follower], [FollowerOptions(avoid="topic")])
    twins.pattern(Patterns(3).offsets("cube"))
    twins.hear(np.zeros((3, 3)), np.zeros((3, 3)))
    for vector in ((0.0, -0.0, 0.5), (0.1, 0.0, 0.0)):
        for followers in (twins.single, twins.batched):
            followers[1].on_avoidance(vector)
        twins.turn()


def test_options_and_methods_of_single_followers_may_change_in_flight() -> None:
    twins = Twins(8, [Follower, InArrays], [FollowerOptions(vel_max=9.0)])
    twins.pattern(Patterns(8).offsets("cube"))
    rng = np.random.default_rng(4)
    seen = []
    for k in range(7):
        twins.hear(rng.normal(size=(8, 3)) * 4, rng.normal(size=(8, 3)))
        for followers in (twins.single, twins.batched):
            if k == 1:
                followers[2].options = FollowerOptions(Kp=0.3, mode="accel", avoid="off")
            if k == 2:
                followers[3].options = replace(followers[3].options, Kp=2.0, avoid="topic")
                followers[3].on_avoidance((0.0, 0.5, 0.0))
            if k == 3:
                followers[0].control_law = lambda position, peers: (0.25, 0.0, 0.0)
                followers[4].neighbours = lambda: {1: 2.0}
            if k == 4:
                followers[1].update = lambda: (0.0, 0.0, 7.0)
            if k == 5:
                del followers[0].control_law
        seen.append(twins.turn())
    assert seen[4][2].tolist() == seen[5][2].tolist() == [0.0, 0.0, 7.0]


def test_weights_and_offsets_may_be_replaced_in_a_follower() -> None:
    twins = Twins(6, [Follower], [FollowerOptions(vel_max=9.0)])
    twins.pattern(Patterns(6).offsets("T"))
    rng = np.random.default_rng(4)
    for k in range(6):
        twins.hear(rng.normal(size=(6, 3)) * 9, rng.normal(size=(6, 3)))
        for followers in (twins.single, twins.batched):
            if k == 1:
                followers[2].weights = {5: 0.3, 0: 1.0, 1: 0.1}
            if k == 2:
                followers[2].weights = {1: 0.1, 0: 1.0, 5: 0.3}  # equal, but not in the same order
            if k == 3:
                followers[4].on_pattern(Patterns(6).offsets("diamond"))
            if k == 4:
                followers[0].on_topology(np.ones((6, 6)) - np.eye(6))
        twins.turn()


def test_a_restarted_follower_repeats_its_warnings() -> None:
    twins = Twins(3, [Follower], [FollowerOptions()])
    places = np.array([[math.nan] * 3, [0.0] * 3, [0.5] * 3])
    for _ in range(2):
        twins.pattern(Patterns(3).offsets("cube"))
        twins.hear(places, places)
        twins.turn()
        twins.turn()
        twins.restart()
    assert len(twins.said[1]) == 4


def test_a_pattern_reaches_classes_that_change_it_too() -> None:
    class Wider(Follower):
        def on_pattern(self, offsets: np.ndarray) -> None:  # type: ignore[override]
            super().on_pattern(2.0 * np.asarray(offsets))

        def on_topology(self, adjacency: np.ndarray) -> None:  # type: ignore[override]
            self.weights = {0: 2.0}

    twins = Twins(4, [Follower, Wider], [FollowerOptions()])
    twins.pattern(Patterns(4).offsets("cube"))
    twins.topology(np.tri(4, k=-1))
    twins.hear(np.zeros((4, 3)), np.zeros((4, 3)))
    twins.turn()
    assert twins.batched[0].weights == {0: 2.0}
    assert twins.batched[1].weights == {0: 1.0, 1: 1.0}


def test_some_followers_of_a_swarm_only() -> None:
    swarm = ArraySwarm(5)
    batch = FollowerBatch([Follower(i, 5, swarm=swarm) for i in (4, 2)], swarm)
    batch.on_pattern(Patterns(5).offsets("cube"))
    swarm.hear(np.zeros((5, 3)))
    commands, there = batch.update()
    assert there.tolist() == [False, False, True, False, True]
    assert (np.linalg.norm(commands, axis=1) > 0.0).tolist() == there.tolist()


def test_bad_batches() -> None:
    swarm = ArraySwarm(3)
    with pytest.raises(ValueError, match="at least one"):
        FollowerBatch([], swarm)
    with pytest.raises(ValueError, match="different"):
        FollowerBatch([Follower(1, 3, swarm=swarm), Follower(1, 3, swarm=swarm)], swarm)
    with pytest.raises(ValueError, match="follower 2: its swarm"):
        FollowerBatch([Follower(1, 3, swarm=swarm), Follower(2, 3)], swarm)
    batch = FollowerBatch([Follower(1, 3, swarm=swarm)], swarm)
    with pytest.raises(PatternError, match="2 x 3"):
        batch.on_pattern([[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="3 x 3"):
        batch.on_topology([1.0])
    assert batch.followers[0].offsets is None
    batch.followers[0].weights = {3: 1.0}
    with pytest.raises(IndexError, match="vehicle 3 does not exist, 0 to 2"):
        batch.update()


def test_an_array_swarm_is_a_swarm_state() -> None:
    swarm, plain = ArraySwarm(3), SwarmState(3)
    places = np.array([[1.0, 2.0, 3.0], [math.inf, 0.0, 0.0], [1e200, -1e200, 0.0]])
    swarm.hear(places, 2 * places)
    for j, place in enumerate(places.tolist()):
        plain.on_position(j, tuple(place))
        plain.on_velocity(j, tuple(2 * p for p in place))
    for _ in range(3):
        assert list(swarm.positions) == plain.positions
        assert list(swarm.velocities) == plain.velocities
        assert [[swarm.fresh(j, t) for j in range(3)] for t in range(3)] == [
            [plain.fresh(j, t) for j in range(3)] for t in range(3)
        ]
        swarm.tick()
        plain.tick()
        for state in (swarm, plain):
            state.on_position(1, (7.0, 8.0, 9.0))
            state.on_position(0, (math.nan, 8.0, 9.0))
            state.on_velocity(0, (7.5, 8.0, 9.0))
    for state in (swarm, plain):
        state.restart()
    assert swarm.positions == plain.positions == [None] * 3
    assert not swarm.fresh(1, 9)
    with pytest.raises(ValueError, match=r"shape \(2, 3\), must be \(3, 3\)"):
        swarm.hear(np.zeros((2, 3)))


@pytest.mark.parametrize("kind", [SwarmState, ArraySwarm])
@given(st.lists(st.floats(width=32), min_size=18, max_size=20), st.floats(-9.0, 9.0))
def test_states_of_all_vehicles_are_stored_as_if_one_by_one(
    kind: type[SwarmState], numbers: list[float], old: float
) -> None:
    together, one_by_one = kind(3), kind(3)
    for swarm in (together, one_by_one):
        swarm.on_position(0, (old, old, old))
        swarm.tick()
    together.hear_states(tuple(numbers))
    for i in range(3):
        x, y, z, vx, vy, vz = numbers[6 * i : 6 * i + 6]
        one_by_one.on_position(i, (x, y, z))
        one_by_one.on_velocity(i, (vx, vy, vz))
    assert list(together.positions) == list(one_by_one.positions)
    assert list(together.velocities) == list(one_by_one.velocities)
    assert [together.fresh(i, 0) for i in range(3)] == [one_by_one.fresh(i, 0) for i in range(3)]
