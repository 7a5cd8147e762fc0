"""Followers computed together over a network equal those computed one by one, to the last bit."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import numpy as np
import pytest

from xtdrone_coordination.array_follower import ArrayFollower, OwnRows, PeerRows
from xtdrone_coordination.batch import FollowerBatch
from xtdrone_coordination.follower import RATE, Follower, FollowerOptions, StarFollower
from xtdrone_coordination.known_swarm_state import ArraySwarm
from xtdrone_coordination.laws.topology import veteran_topology
from xtdrone_coordination.network import Network, NetworkOptions
from xtdrone_coordination.patterns import Patterns, with_leader

COUNT = 30

LOSSY = NetworkOptions(range=9.0, delay=0.1, jitter=0.15, loss=0.5, memory=1.5)
BURSTY = NetworkOptions(loss=0.6, burst=1.5)
NARROW = NetworkOptions(range=12.0, bandwidth=40_000.0, queue=2)


class FeedForward(Follower):
    """A custom law that reads velocities and all other states that its vehicle holds."""

    uses_velocities = True

    def control_law(self, position, peers):
        x, y, z = super().control_law(position, peers)
        far = self.swarm.positions[COUNT - 1]
        return x + peers[0].velocity[0], y, z + (0.1 * far[2] if far else -0.1)


class Nearest(Follower):
    """Selects the nearest of the vehicles with known positions as neighbours."""

    def neighbours(self) -> Mapping[int, float]:
        own = self.swarm.positions[self.id]
        known = [(math.dist(p, own), j) for j, p in enumerate(self.swarm.positions) if p and j != self.id]
        return {j: 1.0 / (1.0 + distance) for distance, j in sorted(known)[:3]}


class Upwards(Follower):
    """A custom avoidance."""

    def avoidance(self):
        x, y, z = super().avoidance()
        return x, y, z + 0.01 * sum(p is not None for p in self.swarm.positions)


class InArrays(ArrayFollower):
    """A law for many followers at once."""

    @classmethod
    def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> np.ndarray:
        return own.stock + peers.mean(peers.velocity) - 0.1 * own.velocity + 0.01 * peers.sum(peers.position)


class ByItself(Follower):
    """Overrides ``update``, which a batch cannot compute."""

    def update(self):
        command = super().update()
        return command and (command[0], 0.5 * command[1], command[2])


class Team:
    """Point vehicles, their network and their followers, computed together or one by one."""

    def __init__(
        self, classes: list[type[Follower]], options: FollowerOptions, radio: NetworkOptions, seed: int
    ) -> None:
        self.network = Network(COUNT, radio, seed)
        self.warnings: list[str] = []
        self.followers = [
            classes[i % len(classes)](i, COUNT, swarm=self.network.known(i), options=options, warn=self.warnings.append)
            for i in range(1, COUNT)
        ]

    def one_by_one(self) -> tuple[np.ndarray, np.ndarray]:
        commands, given = np.zeros((COUNT, 3)), np.zeros(COUNT, dtype=bool)
        for follower in self.followers:
            command = follower.update()
            given[follower.id] = command is not None
            commands[follower.id] = (0.0, 0.0, 0.0) if command is None else command
        return commands, given


STOCK = [Follower]
MIXED = [Follower, FeedForward, Nearest, StarFollower, Upwards, ByItself, InArrays]


@pytest.mark.parametrize("radio", [NetworkOptions(), LOSSY, BURSTY, NARROW], ids=["ideal", "lossy", "bursty", "narrow"])
@pytest.mark.parametrize(
    ("classes", "options"),
    [
        (STOCK, FollowerOptions()),
        (STOCK, FollowerOptions(avoid_radius=2.5, clearance=1.0, Kp=1.3, raw_weights=True, pose_timeout=0.3)),
        (STOCK, FollowerOptions(mode="accel", pose_timeout=0.5)),
        (STOCK, FollowerOptions(avoid="off")),
        (STOCK, FollowerOptions(avoid="topic", avoid_radius=2.5, pose_timeout=0.3)),
        (MIXED, FollowerOptions(pose_timeout=0.5)),
        (MIXED, FollowerOptions(mode="accel")),
    ],
    ids=["stock", "other options", "accel", "no avoidance", "silent topic", "mixed", "mixed accel"],
)
def test_together_is_as_one_by_one(
    classes: list[type[Follower]], options: FollowerOptions, radio: NetworkOptions
) -> None:
    together, single = Team(classes, options, radio, seed=6), Team(classes, options, radio, seed=6)
    batch = FollowerBatch(together.followers, network=together.network)
    rng = np.random.default_rng(2)
    x, v = rng.uniform(-4.0, 4.0, (COUNT, 3)), np.zeros((COUNT, 3))
    x[:, 2] += 12.0
    avoided = missed = 0
    for turn in range(100):
        if turn in (3, 50):
            offsets = Patterns(COUNT).offsets("cube") if turn == 3 else -1.1 * Patterns(COUNT).offsets("pyramid")
            adjacency = veteran_topology(with_leader(offsets)) * rng.uniform(0.5, 2.0, (COUNT, COUNT))
            batch.on_pattern(offsets)
            batch.on_topology(adjacency)
            for follower in single.followers:
                follower.on_pattern(offsets)
                follower.on_topology(adjacency)
        if turn == 70:
            together.followers[8].swarm.restart()
            single.followers[8].swarm.restart()
        seen = x.copy()
        if 20 <= turn < 65:
            seen[[4, 11]] = np.nan  # silent, to others and to themselves
        together.network.step(seen, v)
        single.network.step(seen, v)
        commands, given = batch.update()
        expected, expected_given = single.one_by_one()
        np.testing.assert_array_equal(given, expected_given, str(turn))
        np.testing.assert_array_equal(commands, expected, str(turn))
        assert [f.avoidance_vector for f in together.followers] == [f.avoidance_vector for f in single.followers]
        assert sorted(together.warnings) == sorted(single.warnings)
        avoided += sum(any(f.avoidance_vector) for f in single.followers)
        missed += len(single.warnings)
        v = v + expected / RATE if options.mode == "accel" else expected.copy()
        v[0] = (1.0, 0.5, 0.0)
        x = x + v / RATE
    assert given[1:].all()
    assert avoided or options.avoid == "off"
    assert missed


def test_a_network_batch_accepts_only_its_own_followers() -> None:
    network, other = Network(4), Network(4)
    followers = [Follower(i, 4, swarm=network.known(i)) for i in range(1, 4)]
    with pytest.raises(ValueError, match="follower 1: its swarm is not what the network brings to vehicle 1"):
        FollowerBatch(followers, network=other)
    followers[1].swarm = network.known(1)
    with pytest.raises(ValueError, match="follower 2: its swarm is not what the network brings to vehicle 2"):
        FollowerBatch(followers, network=network)
    with pytest.raises(ValueError, match="either a swarm or a network"):
        FollowerBatch(followers)
    with pytest.raises(ValueError, match="either a swarm or a network"):
        FollowerBatch(followers, ArraySwarm(4), network=network)


def test_a_thousand_are_no_million_pairs() -> None:
    """A broken search would exceed this limit by far on any machine; a correct one takes a few milliseconds."""
    count = 1000
    network = Network(count, NetworkOptions(range=20.0, delay=0.1, loss=0.2), seed=1)
    batch = FollowerBatch([Follower(i, count, swarm=network.known(i)) for i in range(1, count)], network=network)
    places = np.indices((10, 10, 10)).reshape(3, -1).T * 2.0
    batch.on_pattern(places[1:] - places[0])
    batch.on_topology(veteran_topology(places))
    rng = np.random.default_rng(0)
    spent = []
    for _ in range(40):
        places = places + rng.normal(0.0, 0.03, places.shape)
        begin = time.process_time()
        network.step(places, np.zeros_like(places))
        _, given = batch.update()
        spent.append(time.process_time() - begin)
    assert given[1:].all()
    assert np.median(spent[5:]) < 0.3  # s
