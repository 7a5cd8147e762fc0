"""Storage of a sweep's rows: an SQLite file while it runs, a Parquet table at its end.

A folder holds ``runs.sqlite`` (the header of the study and one row per finished run) and, after the end or an
interruption, ``results.parquet``. SQLite's transactions keep every committed row through a killed process or a power
failure, and its lock admits one writer. The file exists only to continue a sweep: users read the table.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterable, Mapping, Set
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from xtdrone_common.files import replacing
from xtdrone_interaction.studies.study_parameters import StudyError

FORMAT = 2  # of runs.sqlite
METADATA = b"xtdrone.study"
FLUSH = 2.0  # s, longest time from a finished run to its commit
_FILE = "runs.sqlite"
_JOURNAL = f"{_FILE}-journal"  # SQLite's own
_RESULTS = "results.parquet"
_TYPES: dict[type, pa.DataType] = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
_TABLES = """
CREATE TABLE IF NOT EXISTS study (header TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS runs (key TEXT PRIMARY KEY, good INTEGER NOT NULL, row TEXT NOT NULL) WITHOUT ROWID;
"""

COLLISION_DISTANCE = 0.5
"""Distance between the centres of two vehicles that have collided, m."""
FIGURES: dict[str, tuple[type, str]] = {
    "settled": (bool, ""),
    "settling_time": (float, "s"),
    "overshoot": (float, "m"),
    "steady_error": (float, "m"),
    "least_distance": (float, "m"),
    "collisions": (int, ""),
    "assigned_distance": (float, "m"),
    "simulated_time": (float, "s"),
    "wall_time": (float, "s"),
}
"""Figures of every run: type and unit.

settled: whether every pattern settled; settling_time: of the slowest pattern, None unless all settled; overshoot and
steady_error: largest over all patterns; least_distance: between any two vehicles after the first pattern's command;
collisions: number of pairs closer than COLLISION_DISTANCE; assigned_distance: sum over all patterns. All but wall_time
are reproducible bit by bit.
"""

Row = dict[str, Any]
"""A run: key, seed, varied parameters, figures, and its error (None for success)."""


class Store:
    """The rows of one sweep, in a folder that is locked against other sweeps.

    Attributes:
        folder: absolute path.
        before: header of the sweep that the folder already holds; None for a new folder.
        rows: finished runs by key; True for success, False for an error.
    """

    def __init__(self, folder: Path, columns: Mapping[str, type], header: Mapping[str, Any]) -> None:
        """Open or create a folder.

        Args:
            folder: path.
            columns: names and types of the table's fixed columns, in order; all others are floats.
            header: description of the study, JSON data.

        Raises:
            StudyError: another sweep is running in the folder, or it does not belong to a sweep of this format.
            OSError: the folder cannot be written to.
        """
        self.folder = folder.resolve()
        self._columns = dict(columns)
        self._header = dict(header)
        self._committed = time.monotonic()
        _check_folder(self.folder)
        self._made = [path for path in (self.folder, *self.folder.parents) if not path.exists()]
        self.folder.mkdir(parents=True, exist_ok=True)
        self._database = _open(self.folder / _FILE)
        found = self._database.execute("SELECT header FROM study").fetchone()
        self.before: dict[str, Any] | None = json.loads(found[0]) if found else None
        self.rows = {key: bool(good) for key, good in self._database.execute("SELECT key, good FROM runs")}

    def __enter__(self) -> Store:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def begin(self) -> None:
        """Store the header."""
        self._database.execute("DELETE FROM study")
        self._database.execute("INSERT INTO study VALUES (?)", (json.dumps(self._header),))
        self.flush()

    def add(self, rows: Iterable[Row]) -> None:
        """Store finished runs, replacing earlier rows of the same keys; see :meth:`tick` for their commit."""
        for row in rows:
            good = row["error"] is None
            values = (row["key"], good, json.dumps(row, default=_number))
            self._database.execute("INSERT OR REPLACE INTO runs VALUES (?, ?, ?)", values)
            self.rows[row["key"]] = good
        self.tick()

    def tick(self) -> None:
        """Commit if the last commit was FLUSH seconds ago; to be called several times a second."""
        if time.monotonic() - self._committed >= FLUSH:
            self.flush()

    def flush(self) -> None:
        """Commit: the rows added so far survive any failure."""
        self._committed = time.monotonic()
        self._database.commit()

    def close(self) -> None:
        """Commit and unlock; a folder that was new and has no run is removed."""
        self._database.commit()
        self._database.close()
        if self.before is None and not self.rows:
            for name in (_FILE, _RESULTS):
                (self.folder / name).unlink(missing_ok=True)
            for path in self._made:
                with suppress(OSError):  # it holds other files
                    path.rmdir()

    def drop(self, keys: Set[str]) -> None:
        """Remove finished runs."""
        self._database.executemany("DELETE FROM runs WHERE key = ?", ((key,) for key in keys))
        self.rows = {key: good for key, good in self.rows.items() if key not in keys}

    def finish(self, keys: Iterable[str]) -> Path:
        """Write the finished runs to results.parquet, in the order of ``keys``, and return its path."""
        self.flush()
        texts = dict(self._database.execute("SELECT key, row FROM runs"))
        rows = [json.loads(texts[key]) for key in keys if key in texts]
        others = sorted({name for row in rows for name in row} - set(self._columns))
        types = self._columns | dict.fromkeys(others, float)
        metadata = {METADATA: json.dumps(self._header)}
        schema = pa.schema([(name, _TYPES[kind]) for name, kind in types.items()], metadata)
        path = self.folder / _RESULTS
        with replacing(path) as draft:
            pq.write_table(pa.Table.from_pylist(rows, schema), draft, compression="zstd")
        return path


def _number(value: Any) -> Any:
    """Return a NumPy scalar as a Python number."""
    return value.item()


def _check_folder(folder: Path) -> None:
    """Refuse a path that cannot become, or is not, a sweep's folder of this format.

    Raises:
        StudyError: it is a file, or holds other files.
    """
    if folder.exists() and not folder.is_dir():
        raise StudyError(f"out: {str(folder)!r} is a file; a folder is needed")
    if not folder.exists() or (folder / _FILE).exists():
        return
    if any(path.name != _JOURNAL for path in folder.iterdir()):
        raise StudyError(f"out: {str(folder)!r} is not empty and no sweep's folder; choose another --out")


def _open(file: Path) -> sqlite3.Connection:
    """Open a database and lock it until it is closed, or the process ends.

    Raises:
        StudyError: another process has locked it, or it is damaged or has another format.
        OSError: it cannot be written to.
    """
    database = sqlite3.connect(file, timeout=0.0)
    try:
        database.execute("PRAGMA locking_mode = EXCLUSIVE")
        database.execute("BEGIN EXCLUSIVE")
        version = database.execute("PRAGMA user_version").fetchone()[0]
        if version not in (0, FORMAT):  # 0: a new file
            raise StudyError(f"out: {file} has format {version}; {FORMAT} is understood, choose another --out")
        database.executescript(f"{_TABLES} PRAGMA user_version = {FORMAT};")
    except sqlite3.Error as error:
        database.close()
        if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
            raise StudyError(f"out: another sweep is running in {file.parent}") from None
        if error.sqlite_errorcode in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT):
            raise StudyError(f"out: {file} is damaged: {error}") from error
        raise OSError(0, str(error), str(file)) from error
    except StudyError:
        database.close()
        raise
    return database
