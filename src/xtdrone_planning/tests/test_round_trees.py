"""The example of a planner of one's own flies around trunks, from corner to corner of its paths."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy_flight import ToyFlight, forest

pytest.importorskip("rospy")

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "round_trees.py"


class ToyDrone:
    """A drone that moves straight to where it is sent, and maps on its way."""

    def __init__(self, flight: ToyFlight) -> None:
        self.flight = flight
        self.verbs: list[str] = []

    def __enter__(self) -> ToyDrone:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return lambda *_: self.verbs.append(name)

    @property
    def position(self) -> tuple[float, ...]:
        return tuple(self.flight.position.tolist())

    def takeoff(self, height: float) -> None:
        self.go_to(*self.flight.position[:2].tolist(), height)

    def go_to(self, *goal: float) -> None:
        start = self.flight.position
        for part in np.linspace(0.1, 1.0, 10):
            self.flight.position = start + part * (np.array(goal) - start)
            self.flight.track.append(self.flight.position)
            self.flight.time += 0.2
            self.flight.scan()


def test_the_example_reaches_its_goal_clear_of_the_trunks(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("round_trees", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    flight = ToyFlight(forest(3))
    drone = ToyDrone(flight)
    monkeypatch.setattr(example, "connect", lambda name: drone)
    monkeypatch.setattr(example, "MapFeed", lambda name, local_map, *_: setattr(flight, "map", local_map))
    example.fly_to("iris_3d_lidar_0", 12.0, 2.0)
    assert np.linalg.norm(flight.position - [12.0, 2.0, 2.0]) < 0.5
    assert flight.clearance() > example.RADIUS
    assert (drone.verbs[0], drone.verbs[-1]) == ("arm", "land")
