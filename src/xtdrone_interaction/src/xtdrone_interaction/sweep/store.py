"""Where a sweep's rows lie: small Parquet files while it runs, one at its end; nothing finished is lost or read half.

A folder holds ``study.json`` (what is swept, and with which software), ``parts/*.parquet`` (rows as they came) and,
after the end or a stop, ``results.parquet``. Every file is written beside its place, brought to the disk (fsync) and
then renamed, so that whatever has its name is whole; a machine that dies leaves at most a ``*.new`` that nobody reads.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterable, Mapping, Sequence, Set
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from xtdrone_interaction.options import OptionError

FORMAT = 1  # of the folder
METADATA = b"xtdrone.study"
FLUSH = 2.0  # s; a row waits so long for others at most
_MOST_PARTS = 200  # then they become one
_MOST_ROWS = 5000  # of one part that comes from the sweep
_TYPES: dict[type, pa.DataType] = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}

Row = Mapping[str, Any]


class Store:
    """The rows of one sweep in a folder that nobody else writes to meanwhile.

    Attributes:
        folder: absolute.
        rows: finished runs by key: whether each went well.
    """

    def __init__(self, folder: Path, columns: Mapping[str, type], header: Mapping[str, Any]) -> None:
        """Open or make a folder.

        Args:
            folder: where.
            columns: names and types of the columns that are known beforehand, in order; others are numbers.
            header: what is swept, plain data.

        Raises:
            OptionError: another sweep uses it, or it is no sweep's folder.
        """
        self.folder = folder.resolve()
        self._columns = dict(columns)
        self._header = dict(header)
        self._waiting: list[Row] = []
        self._written = time.monotonic()
        self._parts = self.folder / "parts"
        self.before = read_header(self.folder)
        self._made = [path for path in (self.folder, *self.folder.parents) if not path.exists()]
        self._parts.mkdir(parents=True, exist_ok=True)
        self._lock = self._locked()
        for left in self._parts.glob("*.new"):
            left.unlink()
        self._number = max((int(part.stem) for part in self._part_files()), default=0)
        self.rows: dict[str, bool] = {}
        for part in self._part_files():
            table = pq.read_table(part, columns=["key", "error"])
            for key, error in zip(table["key"].to_pylist(), table["error"].to_pylist(), strict=True):
                self.rows[key] = error is None

    def __enter__(self) -> Store:
        """Return the store."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Write what waits, and let others use the folder."""
        self.close()

    def begin(self) -> None:
        """Write down what is swept."""
        write_whole(
            self.folder / "study.json", (json.dumps({"format": FORMAT, **self._header}, indent=1) + "\n").encode()
        )

    def add(self, rows: Iterable[Row]) -> None:
        """Take finished runs; they are on the disk within FLUSH seconds as long as this or :meth:`tick` is called."""
        for row in rows:
            self._waiting.append(row)
            self.rows[row["key"]] = row["error"] is None
        self.tick()

    def tick(self) -> None:
        """Write what waits if it is time."""
        if len(self._waiting) >= _MOST_ROWS or time.monotonic() - self._written >= FLUSH:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        self._written = time.monotonic()
        if not self._waiting:
            return
        self._write_part(self._table(self._waiting))
        self._waiting = []
        if len(self._part_files()) > _MOST_PARTS:
            self._merge()

    def close(self) -> None:
        """Write what waits, and let others use the folder; one that was new and has got no run is removed."""
        if self._lock.closed:
            return
        self.flush()
        if self.before is None and not self.rows:
            self._remove()
        self._lock.close()

    def drop(self, keys: Set[str]) -> None:
        """Forget finished runs; dying in between leaves some of them there."""
        self.flush()
        old, table = self._part_files(), self._read()
        kept = table.filter(pc.invert(pc.is_in(table["key"], value_set=pa.array(sorted(keys), type=pa.string()))))
        if kept.num_rows:
            self._write_part(kept)
        for part in old:
            part.unlink()
        self.rows = {key: good for key, good in self.rows.items() if key not in keys}

    def finish(self, keys: Iterable[str]) -> Path:
        """Write results.parquet: the runs that are finished in the order of ``keys``, each once; return its path."""
        self.flush()
        table = self._read()
        place = {key: number for number, key in enumerate(table["key"].to_pylist())}
        order = [place[key] for key in keys if key in place]
        table = table.take(pa.array(order, type=pa.int64()))
        path = self.folder / "results.parquet"
        _write_table(self._typed(table), path, {METADATA: json.dumps(self._header).encode()})
        return path

    def _remove(self) -> None:
        """Take away what was made here: the files, and the folders as far as they are empty."""
        for name in ("study.json", "results.parquet", "lock"):
            (self.folder / name).unlink(missing_ok=True)
        for path in (self._parts, *self._made):
            with suppress(OSError):  # somebody else's files are in it
                path.rmdir()

    def _locked(self) -> Any:
        file = (self.folder / "lock").open("a")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise OptionError(f"out: another sweep is running in {self.folder}") from None
        return file

    def _part_files(self) -> list[Path]:
        return sorted(self._parts.glob("*.parquet"), key=lambda path: int(path.stem))

    def _table(self, rows: Sequence[Row]) -> pa.Table:
        """Return rows as a table; a name that is in one row only is empty in the others."""
        names = list(dict.fromkeys([*self._columns, *(name for row in rows for name in row)]))
        columns = [pa.array([row.get(name) for row in rows], type=self._type(name)) for name in names]
        return pa.table(columns, names=names)

    def _type(self, name: str) -> pa.DataType:
        return _TYPES[self._columns.get(name, float)]

    def _typed(self, table: pa.Table) -> pa.Table:
        """Return a table with the known columns first, in their order, the others by name."""
        others = sorted(set(table.column_names) - set(self._columns))
        return table.select([*(name for name in self._columns if name in table.column_names), *others])

    def _write_part(self, table: pa.Table) -> None:
        self._number += 1
        _write_table(table, self._parts / f"{self._number:06d}.parquet", {})

    def _read(self) -> pa.Table:
        """Return all rows that are on the disk; of a run that was repeated the last one."""
        tables = [pq.read_table(part) for part in self._part_files()]
        if not tables:
            return self._table([])
        table = pa.concat_tables(tables, promote_options="default")
        last = {key: number for number, key in enumerate(table["key"].to_pylist())}
        return table.take(pa.array(sorted(last.values()), type=pa.int64()))

    def _merge(self) -> None:
        """Make one part of all; dying in between leaves rows twice, which reading puts right."""
        old = self._part_files()
        self._write_part(self._read())
        for part in old:
            part.unlink()


def read_header(folder: Path) -> dict[str, Any] | None:
    """Return what was swept in a folder, None if it is new.

    Raises:
        OptionError: it is there but no sweep's folder, or of another version.
    """
    if folder.exists() and not folder.is_dir():
        raise OptionError(f"out: {str(folder)!r} is a file; a folder is needed")
    file = folder / "study.json"
    if not file.is_file():
        if folder.exists() and any(path.name not in ("lock", "parts", "study.json.new") for path in folder.iterdir()):
            raise OptionError(f"out: {str(folder)!r} is not empty and no sweep's folder; choose another --out")
        return None
    try:
        header = json.loads(file.read_text(encoding="utf-8"))
        version = header["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise OptionError(f"out: {file} is damaged: {error!r}") from error
    if version != FORMAT:
        raise OptionError(f"out: {file} has format {version!r}; {FORMAT} is understood, choose another --out")
    return header


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is either the old one or the new one, whatever happens."""
    new = path.with_name(path.name + ".new")
    with new.open("wb") as file:
        file.write(data)
    _put_in_place(new, path)


def _write_table(table: pa.Table, path: Path, metadata: Mapping[bytes, bytes]) -> None:
    new = path.with_name(path.name + ".new")
    pq.write_table(table.replace_schema_metadata(dict(metadata) or None), new, compression="zstd")
    _put_in_place(new, path)


def _put_in_place(new: Path, path: Path) -> None:
    _sync(new)
    os.replace(new, path)
    with suppress(OSError):  # some file systems cannot do it for folders
        _sync(path.parent)


def _sync(path: Path) -> None:
    """Bring a file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
