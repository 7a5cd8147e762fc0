"""One run of a sweep as a function: it returns a row, whatever the user's code does."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import pytest

from xtdrone_interaction.studies.list_of_runs import Plan
from xtdrone_interaction.studies.study_file import make_study
from xtdrone_interaction.studies.study_parameters import StudyError
from xtdrone_interaction.studies.user_code import Source, load
from xtdrone_interaction.sweep.fly_one_run import fly_row

MINE = """
import sys, threading
from xtdrone_coordination.follower import Follower

class Mute(Exception):
    def __init__(self, lock):
        super().__init__(lock)
    def __str__(self):
        raise RuntimeError("no words")

class Locked(Exception):
    pass

class Mine(Follower):
    way = 0
    def control_law(self, position, peers):
        if self.way == 1:
            sys.exit("enough")
        if self.way == 2:
            raise Mute(threading.Lock())
        if self.way == 3:
            raise Locked(threading.Lock())
        return super().control_law(position, peers)

def figures(record):
    return {"class.way": 0.5}
"""


def flown(tmp_path: Path, way: float, **data: Any) -> dict[str, Any]:
    """Fly the first run of a study of three vehicles."""
    (tmp_path / "mine.py").write_text(MINE)
    study = make_study(
        {
            "name": "s",
            "constants": {"n": 3, "pattern": "triangle", "limit": 1.0, "hold": 0.1},
            "parameters": {"class.way": [way]},
            "follower": "mine.py:Mine",
        }
        | data,
        tmp_path,
    )
    common = {
        "engine": study.engine,
        "flight": study.flight,
        "constants": study.constants,
        "sources": {role: source.plain() for role, source in study.sources.items()},
    }
    return fly_row(common, Plan(study)[0].task())


@pytest.mark.parametrize(
    ("way", "error"),
    [(1, "SystemExit: enough"), (2, "Mute: it cannot be written"), (3, "Locked: <unlocked _thread.lock object")],
)
def test_errors_of_a_users_class_become_a_picklable_row(tmp_path: Path, way: float, error: str) -> None:
    row = flown(tmp_path, way)
    assert row["error"].startswith(error)
    assert "mine.py:" in row["error"]
    assert pickle.loads(pickle.dumps(row)) == row
    json.dumps(row)


def test_a_metric_may_not_take_a_parameters_name(tmp_path: Path) -> None:
    row = flown(tmp_path, 0, metric="mine.py:figures")
    assert row["error"].startswith(
        "ValueError: metric returned the name 'class.way'; other names than key, seed, error"
    )
    assert row["class.way"] == 0.0


def test_a_file_that_exits_is_rejected() -> None:
    with pytest.raises(StudyError, match=r"mine\.py cannot be loaded: SystemExit: 3"):
        load("follower", Source("/tmp/mine.py", "A", "import sys\nsys.exit(3)\n"))
