"""``./xtdrone demo landing``: its settings; the tutorial flies it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_interaction import cli
from xtdrone_interaction.missions.landing.cli import robot_start
from xtdrone_interaction.missions.landing.director import Spiral

pytest.importorskip("rospy")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--ugv-speed", "3"], "ugv-speed: '3' is not allowed, 0 to 1.4 m/s"),
        (["--seed", "-1"], "seed: '-1' is not allowed"),
        (["--world", "nowhere"], "world: 'nowhere' is unknown"),
    ],
)
def test_values_that_are_not_allowed_are_named(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = cli.main(["demo", "landing", *options])
    except SystemExit as ended:  # argparse exits
        status = int(str(ended.code))
    assert status == 2
    assert words in capsys.readouterr().err


def test_the_robot_begins_out_of_sight_and_passes_the_place_of_the_search() -> None:
    for seed in range(20):
        x, y, yaw = robot_start(seed)
        assert math.hypot(x, y - 3.0) == pytest.approx(11.0, abs=0.01)
        aside = -math.sin(yaw) * (0.0 - x) + math.cos(yaw) * (3.0 - y)
        assert abs(aside) < 1.4
    assert robot_start(1) == robot_start(1) != robot_start(2)


def test_a_spiral_leaves_no_gap_and_keeps_its_speed() -> None:
    spiral = Spiral(1.0, 2.0, 4.0, 2.0, 20.0)
    points, speeds = [spiral.point], []
    for _ in range(1500):
        speeds.append(math.hypot(*spiral.advance(0.1)))
        points.append(spiral.point)
    assert max(speeds) == pytest.approx(2.0)
    assert np.median(speeds) == pytest.approx(2.0)
    way = np.array(points) - (1.0, 2.0)
    for radius in np.linspace(0.5, 15.0, 20):
        for angle in np.linspace(0.0, 6.0, 20):
            place = radius * np.array([math.cos(angle), math.sin(angle)])
            assert np.min(np.linalg.norm(way - place, axis=1)) < 2.3
