"""``xtdrone sweep`` as a user runs it: to its end, killed and resumed, stopped, changed, with failing user classes."""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from xtdrone_interaction.studies.list_of_runs import Plan
from xtdrone_interaction.studies.study_file import read_study
from xtdrone_interaction.sweep.fly_one_run import fly_batch
from xtdrone_interaction.sweep.sweep_cli import main

PATIENCE = 120.0  # s; bounds a broken test
MINE = """
import time
from xtdrone_coordination.follower import Follower

class Mine(Follower):
    share = 1.0

    def control_law(self, position, peers):
        if self.share > 1.5:
            raise ArithmeticError("too much")
        return tuple(self.share * v for v in super().control_law(position, peers))

def figures(record):
    time.sleep(PAUSE)
    return {"way": abs(record.track.position[-1] - record.track.position[0]).sum()}
"""
STUDY = """
name: small
constants: {n: 3, pattern: triangle, limit: 1.0, hold: 0.2}
parameters: {class.share: SHARES}
follower: mine.py:Mine
metric: mine.py:figures
seeds: SEEDS
"""


def write_study(folder: Path, *, shares: str = "[0.5, 1.0]", seeds: int = 2, pause: float = 0.0) -> Path:
    (folder / "mine.py").write_text(MINE.replace("PAUSE", str(pause)))
    file = folder / "study.yaml"
    file.write_text(STUDY.replace("SHARES", shares).replace("SEEDS", str(seeds)))
    return file


def rows(folder: Path) -> list[dict[str, Any]]:
    return pq.read_table(folder / "results.parquet").drop_columns(["wall_time"]).to_pylist()


def serial(file: Path) -> list[dict[str, Any]]:
    """Return the results of the study's runs, one after the other in this process."""
    study = read_study(file)
    common = {
        "engine": study.engine,
        "flight": study.flight,
        "constants": study.constants,
        "sources": {role: source.plain() for role, source in study.sources.items()},
    }
    flown = fly_batch(common, [run.task() for run in Plan(study)])
    return [{name: value for name, value in row.items() if name != "wall_time"} for row in flown]


def start(file: Path, out: Path) -> subprocess.Popen[str]:
    """Start the command as a terminal does: in its own process group."""
    command = [sys.executable, "-m", "xtdrone_interaction", "sweep", str(file), "--out", str(out), "--workers", "2"]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )  # fmt: skip


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def group_is_gone(group: int) -> bool:
    """Return whether no process of a group runs any more."""
    return processes_of(group) == 0


def processes_of(group: int) -> int:
    """Return the number of running processes of a group."""
    found = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, owner = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        found += int(owner) == group and state != "Z"
    return found


def transaction_is_open(out: Path) -> bool:
    """Return whether rows may be rolled back: the journal of a sweep that holds its lock has a header."""
    try:
        return any((out / "runs.sqlite-journal").read_bytes()[:8])
    except FileNotFoundError:
        return False


def committed(out: Path) -> int:
    """Return the number of runs in the file of a sweep that holds its lock, or was killed."""
    try:
        database = sqlite3.connect(f"file:{out / 'runs.sqlite'}?mode=ro&immutable=1", uri=True)
    except sqlite3.Error:  # the table does not exist yet
        return 0
    try:
        found = int(database.execute("SELECT count(*) FROM runs").fetchone()[0])
        return 0 if transaction_is_open(out) else found
    except sqlite3.Error:  # read during a write
        return 0
    finally:
        database.close()


def test_main_process_killed_and_the_same_command_again(tmp_path: Path) -> None:
    file, out = write_study(tmp_path, seeds=40, pause=0.1), tmp_path / "out"
    process = start(file, out)
    wait_for(lambda: committed(out))
    process.kill()
    process.communicate()
    wait_for(lambda: group_is_gone(process.pid))  # its workers end too
    with contextlib.closing(sqlite3.connect(out / "runs.sqlite")) as database:  # rolls back a half-written run
        kept = int(database.execute("SELECT count(*) FROM runs").fetchone()[0])
    assert 0 < kept < 80
    assert not (out / "results.parquet").exists()

    again = start(file, out)
    text = again.communicate(timeout=PATIENCE)[0]
    assert again.returncode == 0, text
    assert f"{kept} runs exist already, {80 - kept} are missing" in text
    assert "80 of 80 runs exist, 0 of them failed" in text
    write_study(tmp_path, seeds=40)  # without the pause; figures do not depend on it
    expected = serial(file)
    for row, mine in zip(rows(out), expected, strict=True):
        assert row == mine | {"key": row["key"]}
    assert (out / "picture.png").is_file()


def test_interrupt_stops_soon_and_leaves_nothing_running(tmp_path: Path) -> None:
    file, out = write_study(tmp_path, seeds=500, pause=0.1), tmp_path / "out"
    process = start(file, out)
    wait_for(lambda: committed(out))
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does: the whole group receives it
    text = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 128 + signal.SIGINT
    wait_for(lambda: group_is_gone(process.pid))  # processes that have closed their output are about to end
    assert "stopped by SIGINT" in text
    assert "Repeat the command to fly the rest" in text
    assert "Traceback" not in text
    assert 0 < len(rows(out)) < 1000
    assert not (out / "picture.png").exists()
    assert main([str(file), "--out", str(out), "--draw"]) == 1  # no run is flown
    assert (out / "picture.png").is_file()
    assert len(rows(out)) < 1000


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_to_all_while_workers_start_end_the_sweep_in_order(tmp_path: Path, number: signal.Signals) -> None:
    process = start(write_study(tmp_path, seeds=500, pause=0.1), tmp_path / "out")
    wait_for(lambda: processes_of(process.pid) >= 3)  # includes a worker, or the process that starts it
    os.killpg(process.pid, number)
    text = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 128 + number
    wait_for(lambda: group_is_gone(process.pid))  # Python's resource tracker ends a moment after the others
    assert f"stopped by {number.name}" in text
    assert "Traceback" not in text


def test_an_interrupt_while_modules_are_loaded_is_quiet(tmp_path: Path) -> None:
    file = write_study(tmp_path)
    command = [sys.executable, "-X", "importtime", "-m", "xtdrone_interaction", "sweep", str(file), "--dry-run"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert any("numpy" in line for line in process.stderr)
    process.send_signal(signal.SIGINT)
    text = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode in (-signal.SIGINT, 128 + signal.SIGINT)
    assert "Traceback" not in text


def test_runs_that_raise_are_rows_and_more_runs_are_added(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    out = tmp_path / "out"
    arguments = ["--out", str(out), "--workers", "1"]
    assert main([str(write_study(tmp_path, shares="[0.5, 2.0]", seeds=1)), *arguments]) == 1
    good, bad = rows(out)
    assert good["error"] is None
    assert good["way"] > 0.0
    assert bad["error"] == "ArithmeticError: too much (mine.py:10)"
    assert bad["way"] is bad["settled"] is bad["least_distance"] is None
    text = capsys.readouterr().out
    assert "A run has failed (seed 0): ArithmeticError: too much (mine.py:10)\n" in text
    assert "2 of 2 runs exist, 1 of them failed" in text
    assert "  1 failed: ArithmeticError: too much (mine.py:10)\n" in text

    assert main([str(write_study(tmp_path, shares="[0.5, 2.0, 1.0]", seeds=2)), *arguments]) == 1
    text = capsys.readouterr().out
    assert "The study has changed (parameters class.share: [0.5, 2.0] before, [0.5, 2.0, 1.0] now; seeds: [0]" in text
    assert "2 runs exist already, 4 are missing" in text
    assert [(row["class.share"], row["seed"]) for row in rows(out)] == [
        (0.5, 0), (2.0, 0), (1.0, 0), (0.5, 1), (2.0, 1), (1.0, 1)
    ]  # fmt: skip
    assert rows(out)[0] == good

    assert main([str(write_study(tmp_path, shares="[0.5]", seeds=1)), *arguments]) == 2
    assert "has 5 of 6 runs that this study does not have (parameters class.share: [0.5, 2.0, 1.0]" in (
        capsys.readouterr().err
    )
    file = write_study(tmp_path, shares="[0.5, 2.0, 1.0]", seeds=2, pause=0.001)
    for more in ([], ["--retry-failed"]):
        assert main([str(file), *arguments, *more]) == 2
        assert "mine.py has changed (4 good runs were made with another version); choose" in (capsys.readouterr().err)
    assert len(rows(out)) == 6


def test_a_corrected_file_replaces_runs_that_all_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = write_study(tmp_path, seeds=1), tmp_path / "out"
    arguments = [str(file), "--out", str(out), "--workers", "1"]
    good = (tmp_path / "mine.py").read_text()
    (tmp_path / "mine.py").write_text(good.replace("record.track.position[0]", "record.start"))
    assert main(arguments) == 1
    text = capsys.readouterr().out
    assert (
        text.count("A run has failed (seed 0): AttributeError: 'FormationRecord' object has no attribute 'start'") == 1
    )
    assert "  2 failed: AttributeError: 'FormationRecord' object has no attribute 'start' (mine.py:15)\n" in text
    assert "No picture is drawn, because no run succeeded" in text
    assert "Picture:" not in text
    assert not (out / "picture.png").exists()

    (tmp_path / "mine.py").write_text(good)
    for more in ([], ["--retry-failed", "--draw"]):
        assert main([*arguments, *more]) == 2
        assert "mine.py has changed (2 runs failed with another version); --retry-failed flies them" in (
            capsys.readouterr().err
        )
    assert main([*arguments, "--retry-failed"]) == 0
    text = capsys.readouterr().out
    assert "mine.py has changed: 2 runs that failed with another version are dropped" in text
    assert "2 of 2 runs exist, 0 of them failed" in text
    assert [row["error"] for row in rows(out)] == [None, None]
    assert (out / "picture.png").is_file()


def test_the_most_frequent_reasons_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = write_study(tmp_path, shares="[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]", seeds=1), tmp_path / "out"
    failing = 'raise ValueError("a\\n" + "xxxyyzw"[round(10 * self.share) - 1])'
    text = (tmp_path / "mine.py").read_text()
    (tmp_path / "mine.py").write_text(text.replace("return tuple(", failing + "\n        return tuple("))
    assert main([str(file), "--out", str(out), "--workers", "1"]) == 1
    said = [line for line in capsys.readouterr().out.splitlines() if " failed: " in line]
    assert said == [
        f"  {count} failed: ValueError: a {name} (mine.py:11)" for count, name in ((3, "x"), (2, "y"), (1, "z"))
    ]


def test_the_metric_of_the_documentation_works(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "simplified.md").read_text(encoding="utf-8")
    (example,) = (part for part in text.split("```")[1::2] if "def figures(record)" in part)
    (tmp_path / "my_metric.py").write_text(example.removeprefix("python\n"))
    file = write_study(tmp_path, shares="[1.0]", seeds=1)
    file.write_text(file.read_text().replace("metric: mine.py", "metric: my_metric.py"))
    (row,) = serial(file)
    assert row["error"] is None
    assert row["lowest"] > 5.0
    assert 0.0 < row["longest_way"] < 100.0


def test_without_runs_there_is_no_folder_and_no_results_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    file, out = str(write_study(tmp_path)), tmp_path / "new" / "out"
    for arguments in (["--draw"], ["--scheduler", "tcp://127.0.0.1:1"]):
        assert main([file, "--out", str(out), *arguments]) == 1
        text = capsys.readouterr().out
        assert "There are no results; " in text
        assert "Results:" not in text
        assert not out.parent.exists()
    with pytest.raises(SystemExit, match=r"^2$"):
        main([file, "--out", str(out), "--workers", "0"])
    assert not out.parent.exists()


def test_rejects_unsupported_requests(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(write_study(tmp_path))
    with pytest.raises(SystemExit, match=r"^2$"):
        main([file, "--out", str(tmp_path / "out"), "--workers", "0"])
    assert "--workers: '0' is not allowed, a whole number from 1 to 1024" in capsys.readouterr().err
    for arguments, message in (
        (["--metric", "beauty", "--x", "n"], "x: 'n' is not varied in this study; there are: class.share, seed"),
        (["--out", file], "is a file; a folder is needed"),
    ):
        assert main([file, "--out", str(tmp_path / "out"), *arguments]) == 2
        assert message in capsys.readouterr().err
    assert main([str(tmp_path / "none.yaml")]) == 2
    assert "none.yaml: No such file" in capsys.readouterr().err
    assert main([file, "--out", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:1"]) == 1
    assert "scheduler: no Dask scheduler answers at 'tcp://127.0.0.1:1'" in capsys.readouterr().err
