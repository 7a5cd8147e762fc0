"""Random use of Swarm: batch against one by one, restart, documented exceptions only, no NaN."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from xtdrone_coordination.array_follower import ArrayFollower, OwnRows, PeerRows
from xtdrone_coordination.follower import Follower, StarFollower
from xtdrone_coordination.laws.consensus import Peer, Vector
from xtdrone_coordination.laws.topology import veteran_topology
from xtdrone_coordination.leader import CommandError, Leader
from xtdrone_coordination.network import NetworkOptions
from xtdrone_coordination.patterns import PatternError
from xtdrone_swarm import Model, Swarm

Rng = np.random.Generator


class Smooth(Follower):
    """Keeps a state, which a restart clears."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.last = np.zeros(3)

    def restart(self) -> None:
        super().restart()
        self.last = np.zeros(3)

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> np.ndarray:  # type: ignore[override]
        self.last = 0.7 * self.last + 0.3 * np.array(super().control_law(position, peers))
        return self.last


class Nearest(Follower):
    """Selects its neighbours again in every turn."""

    def neighbours(self) -> Mapping[int, float]:
        own = self.swarm.positions[self.id]
        known = {j: p for j, p in enumerate(self.swarm.positions) if p is not None and j != self.id}
        return {} if own is None else {j: 1.0 for j in sorted(known, key=lambda j: math.dist(known[j], own))[:2]}


class Hasty(Follower):
    """Changes its options, and returns unusable values now and then."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.first = self.options

    def restart(self) -> None:
        super().restart()
        self.options = self.first

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        self.options = replace(self.options, vel_max=1.0 + abs(math.sin(position[0])))
        x, y, z = super().control_law(position, peers)
        return (math.nan, y, z) if 3.0 < position[1] < 3.2 else (x, y, z)


class Upwards(Follower):
    def avoidance(self) -> list[float]:  # type: ignore[override]
        x, y, z = super().avoidance()
        return [x, y, z + 0.2]


class InArrays(ArrayFollower):
    @classmethod
    def control_laws(cls, options: Any, own: OwnRows, peers: PeerRows) -> np.ndarray:
        return own.stock + 0.2 * (peers.mean(peers.velocity) - own.velocity)


class Deep(Follower):
    def update(self) -> Vector | None:
        command = super().update()
        return None if command is None else (command[0], command[1], 0.5 * command[2])


class Sparse(Leader):
    """A leader whose topology leaves some followers without neighbours, and disconnects others."""

    def topology(self, offsets: np.ndarray) -> np.ndarray:
        listens = veteran_topology(offsets)
        listens[1::4] = 0
        if self.count > 4:
            listens[[3, 4]] = 0
            listens[3, 4] = listens[4, 3] = 2
        return listens


FOLLOWERS = [Follower, Follower, StarFollower, Smooth, Nearest, Hasty, Upwards, InArrays, Deep]
PATTERNS = ["cube", "triangle", "origin", "circle", "sphere:spacing=0.5", "grid:spacing=2", "text:A", "text:",
            "cloud:/", "nothing", "cube:spacing=nan", "pyramid:spacing=4", "sphere:font=x", ":", ""]  # fmt: skip
COMMANDS = ["HOVER", "ARM", "DISARM", "OFFBOARD", "AUTO.LAND", "AUTO.TAKEOFF", "AUTO.RTL", "AUTO.LOITER", "POSCTL",
            "MANUAL", "mission1", "waiting", "stop controlling", "", "cube", "what?"]  # fmt: skip


def settings_of(rng: Rng) -> dict[str, Any]:
    """Return random settings of a swarm, all allowed."""
    pick = lambda *values: values[rng.integers(len(values))]  # noqa: E731
    count = int(pick(2, 3, 5, 9, 9, 26, 40))
    accelerations = bool(rng.random() < 0.25)
    network = None
    if rng.random() < 0.5:
        network = NetworkOptions(
            range=pick(math.inf, 4.0, 30.0), delay=pick(0.0, 1 / 30, 0.21), jitter=pick(0.0, 0.1),
            loss=pick(0.0, 0.4, 1.0), burst=pick(0.0, 0.5), bandwidth=pick(math.inf, 2e4),
            queue=pick(1, 4), memory=pick(0.1, 2.0),
        )  # fmt: skip
    return {
        "count": count,
        "follower": pick(*FOLLOWERS),
        "leader": pick(Leader, Sparse),
        "model": pick(None, "first-order", Model(delay=0.0, acceleration=math.inf), Model(delay=1.0, speed=0.5)),
        "places": None if rng.random() < 0.6 else np.abs(rng.normal(size=(count, 3)) * pick(0.0, 1.0, 20.0)),
        "airborne": bool(rng.random() < 0.7),
        "altitude": pick(0.5, 10.0, 40.0),
        "follower_options": {
            "mode": "accel" if accelerations else "vel",
            "Kp": pick(0.2, 1.0, 30.0),
            "raw_weights": bool(rng.random() < 0.3),
            "vel_max": pick(0.3, 2.0, 50.0),
            "avoid": pick("own", "own", "off", "topic"),
            "clearance": pick(0.0, 0.7, 1.4),
            "pose_timeout": pick(0.05, 1.0),
        },
        "leader_options": {"avoid": pick("off", "own"), "min_height": pick(0.0, 0.5)},
        "network": network,
        "seed": int(rng.integers(1000)),
    }


def one_by_one(swarm: Swarm) -> None:
    """Compute each follower separately, as those that override ``update``."""
    for follower in swarm.followers:
        follower.update = follower.update  # type: ignore[method-assign]


def fly(swarm: Swarm, seed: int, turns: int) -> list[bytes]:
    """Use a swarm at random; return the observations of each turn."""
    rng = np.random.default_rng(seed)
    seen = []
    for turn in range(turns):
        chance = rng.random(5)
        name, text = rng.choice(PATTERNS), rng.choice(COMMANDS)
        index, course = int(rng.integers(len(swarm.followers) + 1)), rng.choice([0.0, 0.0005, 0.7, -30.0], 4)
        if chance[0] < 0.05 or turn == 3:
            refused(swarm.choose, str(name) if turn != 3 else "circle")
        if chance[1] < 0.05:
            refused(swarm.command, str(text))
        if chance[2] < 0.05:
            swarm.vehicle(index, str(text))
        if chance[3] < 0.05:
            swarm.steer(course[:3], float(course[3]))
        if chance[4] < 0.02:
            swarm.followers[0].restart()
        swarm.step()
        state = np.concatenate([swarm.positions, swarm.velocities])
        assert np.isfinite(state).all()
        assert np.isfinite(swarm.vehicles.yaw).all()
        assert (swarm.positions[:, 2] >= 0.0).all()
        seen.append(state.tobytes() + repr((swarm.vehicles.mode, swarm.vehicles.armed, swarm.cut_off())).encode())
    return seen


def refused(what: Any, text: str) -> None:
    """Pass a command that may be rejected, by the documented exceptions only."""
    with suppress(PatternError, CommandError):
        what(text)


@pytest.mark.parametrize("seed", range(24))
def test_any_use(seed: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)
    rng = np.random.default_rng([77, seed])
    settings = settings_of(rng)
    swarm, other = Swarm(**settings), Swarm(**settings)
    one_by_one(other)
    flown = fly(swarm, seed, 90)
    assert flown == fly(other, seed, 90), "computed together as one by one"
    swarm.restart()
    assert flown == fly(swarm, seed, 90), "restarted as at first"
    assert swarm.record is not None
    assert len(swarm.record.times) == 90
