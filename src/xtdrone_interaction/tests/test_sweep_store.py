"""The store of a sweep's rows: commits, locks, every run once, column types, rejected folders."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from xtdrone_interaction.studies import result_store as stores
from xtdrone_interaction.studies.result_store import METADATA, Store
from xtdrone_interaction.studies.study_parameters import StudyError

COLUMNS = {"key": str, "seed": int, "n": int, "error": str, "settled": bool, "time": float}
HEADER = {"study": {"name": "s", "parameters": {"n": [4]}, "constants": {}}}


def row(number: int, **values: Any) -> dict[str, Any]:
    return {"key": f"k{number}", "seed": number, "n": 4, "error": None, "settled": True, "time": 0.1 * number} | values


def opened(folder: Path) -> Store:
    store = Store(folder, COLUMNS, HEADER)
    store.begin()
    return store


def test_rows_are_read_in_the_plans_order_with_types_and_study(tmp_path: Path) -> None:
    with opened(tmp_path / "a") as store:
        store.add([row(2), row(0, error="it broke", settled=None, time=None)])
        store.flush()
        store.add([row(1, own=7)])
        path = store.finish(["k0", "k1", "k2", "k3"])
    table = pq.read_table(path)
    assert table["key"].to_pylist() == ["k0", "k1", "k2"]
    assert table["time"].to_pylist() == [None, 0.1, 0.2]
    assert table["own"].to_pylist() == [None, 7.0, None]
    types = {field.name: field.type for field in table.schema}
    assert types == {
        "key": pa.string(), "seed": pa.int64(), "n": pa.int64(), "error": pa.string(), "settled": pa.bool_(),
        "time": pa.float64(), "own": pa.float64(),
    }  # fmt: skip
    assert json.loads(table.schema.metadata[METADATA]) == HEADER


def committed(folder: Path) -> list[str]:
    """Return the keys that another process finds after a crash at this moment."""
    copy = folder.with_name(folder.name + "-copy")
    copy.mkdir(exist_ok=True)
    for name in ("runs.sqlite", "runs.sqlite-journal"):
        (copy / name).unlink(missing_ok=True)
        if (folder / name).exists():
            (copy / name).write_bytes((folder / name).read_bytes())
    database = sqlite3.connect(copy / "runs.sqlite")
    try:
        return [key for (key,) in database.execute("SELECT key FROM runs ORDER BY key")]
    finally:
        database.close()


def test_committed_rows_are_found_again(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.add([row(0), row(1, error="it broke")])
    with opened(tmp_path) as again:
        assert again.before == HEADER
        assert again.rows == {"k0": True, "k1": False}
        again.add([row(2)])
        assert pq.read_table(again.finish(["k0", "k1", "k2"])).num_rows == 3


WRITER = """
import sys
from pathlib import Path
from xtdrone_interaction.studies import result_store as stores
stores.FLUSH = 0.0
with stores.Store(Path(sys.argv[1]), {"key": str, "error": str}, {}) as store:
    store.begin()
    for number in range(10**9):
        store.add([{"key": f"{number}-{part}", "error": None} for part in range(3)])
        print(number, flush=True)
"""


def test_a_killed_writer_leaves_every_committed_row_and_no_half_of_a_commit(tmp_path: Path) -> None:
    known: set[str] = set()
    for attempt in range(5):
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path / "a")], stdout=subprocess.PIPE)
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(0.03 * attempt)
        process.kill()
        lines = (first + process.stdout.read()).splitlines()
        assert process.wait() == -signal.SIGKILL
        known |= {f"{int(line)}-{part}" for line in lines for part in range(3)}
        with Store(tmp_path / "a", {"key": str, "error": str}, {}) as store:  # no lock is left
            assert known <= set(store.rows)
            assert len(store.rows) % 3 == 0
            known = set(store.rows)


def test_a_second_process_is_rejected_and_changes_nothing(tmp_path: Path) -> None:
    with opened(tmp_path / "a") as store:
        store.add([row(0)])
        second = subprocess.run(
            [sys.executable, "-c", WRITER, str(tmp_path / "a")], capture_output=True, text=True, check=False
        )
        assert "StudyError: out: another sweep is running in" in second.stderr
        store.add([row(1)])
    with opened(tmp_path / "a") as again:
        assert again.rows == {"k0": True, "k1": True}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_to_is_an_error_of_the_system(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OSError, match="unable to open database file"):
        opened(tmp_path)


def test_a_run_that_is_flown_again_counts_once_and_the_last_time(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.add([row(0, error="it broke")])
        store.flush()
        store.add([row(0, time=5.0)])
        table = pq.read_table(store.finish(["k0"]))
    assert table["time"].to_pylist() == [5.0]
    assert table["error"].to_pylist() == [None]
    with opened(tmp_path) as again:
        assert again.rows == {"k0": True}


def test_rows_are_committed_after_a_while_without_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(stores.time, "monotonic", lambda: now)
    with opened(tmp_path / "a") as store:
        store.add([row(0)])
        assert committed(tmp_path / "a") == []
        now += stores.FLUSH
        store.tick()
        assert committed(tmp_path / "a") == ["k0"]


def test_no_runs_make_an_empty_table(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        table = pq.read_table(store.finish(["k0"]))
    assert table.num_rows == 0
    assert table.column_names == list(COLUMNS)


def test_a_new_folder_without_runs_is_removed_and_others_remain(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for folder in (tmp_path / "new" / "deep", tmp_path / "mine"):
        with opened(folder) as store:
            store.finish(["k0"])
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert not list((tmp_path / "mine").iterdir())
    with opened(tmp_path / "mine") as store:
        store.add([row(0)])
    with opened(tmp_path / "mine") as store:
        store.drop({"k0"})
    assert (tmp_path / "mine" / "runs.sqlite").is_file()  # it existed before


def test_dropped_runs_are_removed_and_others_remain(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.add([row(0, error="it broke"), row(1), row(2, error="it broke")])
        store.drop({"k0", "k2"})
        assert store.rows == {"k1": True}
    with opened(tmp_path) as again:
        assert again.rows == {"k1": True}
        assert pq.read_table(again.finish(["k0", "k1", "k2"]))["key"].to_pylist() == ["k1"]


def test_rejects_folders_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StudyError, match=r"file' is a file; a folder is needed"):
        opened(tmp_path / "file")
    with pytest.raises(StudyError, match="is not empty and no sweep's folder"):
        opened(tmp_path)
    with opened(tmp_path / "a") as store:
        store.add([row(0)])
        with pytest.raises(StudyError, match="another sweep is running in"):
            opened(tmp_path / "a")
    database = sqlite3.connect(tmp_path / "a" / "runs.sqlite")
    database.execute("PRAGMA user_version = 99")
    database.close()
    with pytest.raises(StudyError, match=r"runs\.sqlite has format 99; 2 is understood"):
        opened(tmp_path / "a")
    (tmp_path / "a" / "runs.sqlite").write_text("{" * 200)
    with pytest.raises(StudyError, match=r"runs\.sqlite is damaged: file is not a database"):
        opened(tmp_path / "a")
