"""The results' folder: whole files only, every run once, types, other studies refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from xtdrone_interaction.options import OptionError
from xtdrone_interaction.sweep import store as stores
from xtdrone_interaction.sweep.store import METADATA, Store

COLUMNS = {"key": str, "seed": int, "n": int, "error": str, "settled": bool, "time": float}
HEADER = {"study": {"name": "s", "parameters": {"n": [4]}, "constants": {}}}


def row(number: int, **values: Any) -> dict[str, Any]:
    return {"key": f"k{number}", "seed": number, "n": 4, "error": None, "settled": True, "time": 0.1 * number} | values


def opened(folder: Path) -> Store:
    store = Store(folder, COLUMNS, HEADER)
    store.begin()
    return store


def test_rows_come_back_in_the_plans_order_with_types_and_study(tmp_path: Path) -> None:
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


def test_what_was_written_is_there_again_and_half_files_are_not(tmp_path: Path) -> None:
    store = opened(tmp_path)
    store.add([row(0), row(1, error="it broke")])
    store.flush()
    whole = next((tmp_path / "parts").glob("*.parquet")).read_bytes()
    store.close()
    (tmp_path / "parts" / "000002.parquet.new").write_bytes(whole[:100])  # killed while writing
    with opened(tmp_path) as again:
        assert again.rows == {"k0": True, "k1": False}
        assert not list((tmp_path / "parts").glob("*.new"))
        again.add([row(2)])
        assert pq.read_table(again.finish(["k0", "k1", "k2"])).num_rows == 3


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


def test_many_parts_become_one_and_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "_MOST_PARTS", 3)
    with opened(tmp_path) as store:
        for number in range(20):
            store.add([row(number)])
            store.flush()
            assert len(list((tmp_path / "parts").glob("*.parquet"))) <= 3
    with opened(tmp_path) as again:
        assert len(again.rows) == 20
        keys = [f"k{number}" for number in range(20)]
        assert pq.read_table(again.finish(keys))["key"].to_pylist() == keys


def test_dying_between_a_merge_and_its_clean_up_leaves_every_run_once(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.add([row(0)])
        store.flush()
        part = next((tmp_path / "parts").glob("*.parquet"))
        (part.with_name("000007.parquet")).write_bytes(part.read_bytes())
    with opened(tmp_path) as again:
        assert pq.read_table(again.finish(["k0"])).num_rows == 1
        again.add([row(1)])
        again.flush()
        assert (tmp_path / "parts" / "000008.parquet").is_file()


def test_rows_are_on_the_disk_after_a_while_without_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(stores.time, "monotonic", lambda: now)
    with opened(tmp_path) as store:
        store.add([row(0)])
        assert not list((tmp_path / "parts").glob("*"))
        now += stores.FLUSH
        store.tick()
        assert len(list((tmp_path / "parts").glob("*.parquet"))) == 1


def test_no_runs_make_an_empty_table(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        table = pq.read_table(store.finish(["k0"]))
    assert table.num_rows == 0
    assert table.column_names == list(COLUMNS)


def test_a_new_folder_without_runs_goes_again_and_others_stay(tmp_path: Path) -> None:
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
    assert (tmp_path / "mine" / "study.json").is_file()  # it was there before


def test_dropped_runs_are_gone_and_others_stay(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        store.add([row(0, error="it broke"), row(1), row(2, error="it broke")])
        store.drop({"k0", "k2"})
        assert store.rows == {"k1": True}
    with opened(tmp_path) as again:
        assert again.rows == {"k1": True}
        assert pq.read_table(again.finish(["k0", "k1", "k2"]))["key"].to_pylist() == ["k1"]


def test_refuses_folders_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OptionError, match=r"file' is a file; a folder is needed"):
        opened(tmp_path / "file")
    with pytest.raises(OptionError, match="is not empty and no sweep's folder"):
        opened(tmp_path)
    with opened(tmp_path / "a") as store:
        store.add([row(0)])
        with pytest.raises(OptionError, match="another sweep is running in"):
            opened(tmp_path / "a")
    (tmp_path / "a" / "study.json").write_text('{"format": 99}')
    with pytest.raises(OptionError, match="has format 99; 1 is understood"):
        opened(tmp_path / "a")
    (tmp_path / "a" / "study.json").write_text("{")
    with pytest.raises(OptionError, match=r"study\.json is damaged"):
        opened(tmp_path / "a")
