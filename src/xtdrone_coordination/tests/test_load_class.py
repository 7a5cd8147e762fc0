"""User-defined classes, by file or module, the example included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_formation import Swarm

from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_common.programs.user_classes import load_class, nothing_overridden
from xtdrone_coordination.follower import Follower, StarFollower
from xtdrone_coordination.leader import Leader

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "feed_forward_follower.py"


def test_the_example_does_not_lag_behind_a_moving_leader() -> None:
    swarm = Swarm(6, load_class(str(EXAMPLE), Follower), vel_max=2.0)
    swarm.command("diamond")
    swarm.leader_velocity = np.array([0.5, 0.2, 0.0])
    swarm.fly(25.0)
    assert swarm.error < 0.05


def test_class_of_a_module() -> None:
    assert load_class("xtdrone_coordination.follower:StarFollower", Follower) is StarFollower


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("/nowhere/mine.py", "cannot be imported"),
        ("no_such_module:Mine", "cannot be imported"),
        (f"{EXAMPLE}:Missing", "class Missing that inherits Follower"),
        ("xtdrone_coordination.follower", "one class that inherits Follower; it has Follower, StarFollower"),
    ],
)
def test_load_errors_are_explained(text: str, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        load_class(text, Follower)


def test_a_follower_is_no_leader() -> None:
    with pytest.raises(ArgumentError, match="inherits Leader"):
        load_class(f"{EXAMPLE}:FeedForwardFollower", Leader)


@pytest.mark.parametrize(
    ("text", "message"),
    [("import sys\nsys.exit(4)", "SystemExit: 4"), ("1 / 0", "ZeroDivisionError: "), ("x = (", "SyntaxError: ")],
)
def test_a_file_that_does_not_load_is_reported(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "strange.py"
    file.write_text(text)
    with pytest.raises(ArgumentError, match=rf"strange\.py cannot be imported: {message}"):
        load_class(str(file), Follower)


def test_a_class_that_overrides_nothing_is_reported() -> None:
    class Misspelt(Follower):
        def contrl_law(self, position, peers):
            return position

    class Own(Follower):
        uses_velocities = True

    assert "Misspelt overrides nothing of Follower" in nothing_overridden(Misspelt, Follower)
    assert nothing_overridden(Own, Follower) == nothing_overridden(Follower, Follower) == ""
