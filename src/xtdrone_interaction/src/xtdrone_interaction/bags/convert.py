"""``./xtdrone convert FILE --to FORMAT``: convert bags to ROS 2 bags, MCAP, CSV or Parquet, or repair them.

Exit status: 0 if all readable messages were converted, 1 if none is readable, 2 for an invalid value.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import io
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray
from rich.console import Console
from rosbags.convert import ConverterError
from rosbags.convert.converter import convert as rosbags_convert
from rosbags.rosbag1 import Writer

from xtdrone_interaction.bags.bag_kinds import (
    Layouts,
    Losses,
    Source,
    by_connection,
    large_batches,
    open_source,
    whole_messages,
)
from xtdrone_interaction.bags.decode import Decoded, Layout, List, MessageError, Rows, Text, Texts
from xtdrone_interaction.bags.ros1bag import BagError, Batch, Connection
from xtdrone_interaction.command_options import OptionError

FORMATS = {
    "mcap": "ROS 2 bag in MCAP format, which Foxglove opens",
    "ros2": "ROS 2 bag in SQLite format",
    "bag": "complete, indexed ROS 1 bag, from a truncated one",
    "csv": "one table per topic",
    "parquet": "one table per topic, typed and compressed",
}
_AT_ONCE = 200  # tables open at once; with more topics, the bag is read several times
_WAITING = 4_000_000  # bytes of a table buffered before they are written
_TIME = "bag_time_ns"
_BYTES = "u1"


def chosen(patterns: Sequence[str] | None) -> Callable[[str], bool]:
    """Return a predicate for topics that match a pattern such as /iris_*/mavros/*; without patterns all match."""
    return lambda topic: not patterns or any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def rewrite(source: Source, target: Path, wanted: Callable[[str], bool], losses: Losses, *, check: bool = False) -> int:
    """Write everything readable to an indexed ROS 1 bag with LZ4 compression; return the number of messages.

    Args:
        source: the bag to read.
        target: path of the new bag.
        wanted: predicate of topics.
        losses: records skipped messages.
        check: skip messages that do not match their definition.
    """
    count = 0
    writer = Writer(target)
    writer.set_compression(Writer.CompressionFormat.LZ4)
    layouts = Layouts()
    with writer:
        made: dict[Connection, Any] = {}
        for batch in large_batches(source):
            good = _good(source, batch, layouts, losses, wanted) if check else None
            rows = zip(
                batch.connection.tolist(),
                batch.time.tolist(),
                batch.offset.tolist(),
                batch.length.tolist(),
                strict=True,
            )
            for row, (number, time, offset, length) in enumerate(rows):
                connection = source.connections.get(number)
                if connection is None:
                    losses.unknown += 1
                    continue
                if not wanted(connection.topic) or (good is not None and not good[row]):
                    continue
                if connection not in made:
                    made[connection] = writer.add_connection(
                        connection.topic,
                        connection.type.replace("/", "/msg/") if "/msg/" not in connection.type else connection.type,
                        msgdef=connection.definition,
                        md5sum=connection.md5,
                        latching=int(connection.latching),
                    )
                writer.write(made[connection], time, batch.data[offset : offset + length].tobytes())
                count += 1
    losses.failed = layouts.failed
    return count


def _good(
    source: Source, batch: Batch, layouts: Layouts, losses: Losses, wanted: Callable[[str], bool]
) -> NDArray[np.bool_]:
    """Return a mask of the messages of a batch that match their definitions, shape (n,)."""
    good = np.zeros(len(batch.connection), bool)
    for number in np.unique(batch.connection).tolist():
        connection = source.connections.get(number)
        if connection is None or not wanted(connection.topic) or (layout := layouts.of(connection)) is None:
            continue
        rows = np.flatnonzero(batch.connection == number)
        part = Batch(batch.data, batch.connection[rows], batch.time[rows], batch.offset[rows], batch.length[rows])
        kept = whole_messages(layout, part)
        losses.add(connection, layout, part, kept)
        good[rows[kept]] = True
    return good


def to_ros2(source: Source, target: Path, storage: str, topics: Sequence[str] | None, losses: Losses) -> None:
    """Write a ROS 2 bag through a temporary ROS 1 bag, because rosbags relies on the index of its input.

    Args:
        source: the bag to read.
        target: folder that does not exist yet.
        storage: ``mcap`` or ``sqlite3``.
        topics: patterns; None for all.
        losses: records skipped messages.

    Raises:
        BagError: rosbags cannot convert it.
    """
    whole = target.with_name(f".{target.name}.whole.bag")
    whole.unlink(missing_ok=True)
    try:
        if not rewrite(source, whole, chosen(topics), losses, check=True):
            raise BagError(_nothing(source, losses))
        _convert(whole, target, storage)
    except (ConverterError, AssertionError) as error:
        shutil.rmtree(target, ignore_errors=True)
        raise BagError(f"convert: {str(source.path)!r}: {error}") from error
    finally:
        whole.unlink(missing_ok=True)


def _nothing(source: Source, losses: Losses) -> str:
    """Return the error message for a conversion without any message."""
    text = f"convert: {str(source.path)!r} has no messages on the selected topics"
    notes = [*source.notes, *losses.notes()]
    return "; ".join([f"{text} that can be read" if notes else text, *notes])


def _convert(bag: Path, target: Path, storage: str) -> None:
    """Convert an indexed ROS 1 bag."""
    with contextlib.redirect_stdout(io.StringIO()):  # it prints every type unknown to ROS 2
        rosbags_convert([bag], target, storage, 8, None, "file", None, None, (), (), (), ())


class _Table:
    """The table of one topic, written in parts."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path = path
        self.kind = kind
        self.rows = 0
        self._waiting: list[pa.Table] = []
        self._writer: Any = None

    def add(self, table: pa.Table) -> None:
        """Append rows."""
        self.rows += len(table)
        self._waiting.append(table)
        if sum(part.nbytes for part in self._waiting) >= _WAITING:
            self._write()

    def _write(self) -> None:
        if not self._waiting:
            return
        table = pa.concat_tables(self._waiting)
        self._waiting = []
        if self._writer is None:
            make = pa.parquet.ParquetWriter if self.kind == "parquet" else pa.csv.CSVWriter
            self._writer = make(str(self.path), table.schema)
        self._writer.write_table(table)

    def close(self) -> None:
        """Write the buffered rows and close the file."""
        self._write()
        if self._writer is not None:
            self._writer.close()


def to_tables(
    source: Source, folder: Path, kind: str, wanted: Callable[[str], bool], losses: Losses
) -> list[tuple[str, Path, int]]:
    """Write one table per topic and message type.

    Args:
        source: the bag to read.
        folder: of the tables.
        kind: ``csv`` or ``parquet``.
        wanted: predicate of topics.
        losses: records skipped messages.

    Returns:
        Topic, path and rows of each table.
    """
    layouts = Layouts()
    tables: dict[tuple[str, str], _Table] = {}
    done: set[tuple[str, str]] = set()
    names: set[str] = set()
    written = []
    while True:
        waiting = False
        losses.unknown = 0
        for batch in large_batches(source):
            for number, messages in by_connection(batch):
                connection = source.connections.get(number)
                if connection is None:
                    losses.unknown += len(messages.time)
                    continue
                key = connection.topic, connection.md5
                if not wanted(connection.topic) or key in done:
                    continue
                if key not in tables and len(tables) >= _AT_ONCE:
                    waiting = True
                    continue
                layout = layouts.of(connection)
                if layout is None:
                    continue
                if key not in tables:
                    tables[key] = _Table(folder / f"{_file_name(connection.topic, names)}.{kind}", kind)
                made, kept = columns(layout, messages, kind)
                losses.add(connection, layout, messages, kept)
                if made is not None:
                    tables[key].add(made)
        for key, table in tables.items():
            table.close()
            if table.rows:
                written.append((key[0], table.path, table.rows))
        done |= tables.keys()
        tables.clear()
        if not waiting:
            losses.failed = layouts.failed
            return sorted(written)


def _file_name(topic: str, taken: set[str]) -> str:
    """Return a unique file name for the table of a topic."""
    stem = re.sub(r"[^\w.-]+", "_", topic.strip("/")) or "topic"
    name, number = stem, 1
    while name in taken:
        number += 1
        name = f"{stem}_{number}"
    taken.add(name)
    return name


def columns(layout: Layout, batch: Batch, kind: str) -> tuple[pa.Table | None, Rows]:
    """Return messages as a table, and the rows of the batch that are in it.

    The columns are the recorder's time and the fields by path; the table is None if no message is valid. Arrays of
    numbers have one column per element. Lists are lists in Parquet and JSON in CSV; raw bytes (images) are bytes in
    Parquet and only counted in CSV. Types that cannot be traversed have one JSON column per field.
    """
    if not layout.traversable:
        return _by_message(layout, batch)
    paths = {part.path for part in layout.parts if isinstance(part, Text | Texts | List)} | layout.fields.keys()
    decoded = layout.decode(batch.data, batch.offset, batch.length, paths)
    table: dict[str, Any] = {_TIME: batch.time[decoded.kept]}
    if not len(decoded.kept):
        return None, decoded.kept
    for part in layout.parts:
        if isinstance(part, Text):
            table[part.path] = pa.array(decoded.texts(part.path), pa.string())
        elif isinstance(part, Texts):
            table |= _lists(part.path, [list(texts) for texts in decoded.text_lists(part.path)], kind, pa.string())
        elif isinstance(part, List):
            table |= _records(decoded, part, kind)
        else:
            for path, _, count in getattr(part, "fields", ()):
                values = decoded.found[path]
                if count == 1:
                    table[path] = np.ascontiguousarray(values)
                else:
                    table |= {f"{path}.{i}": np.ascontiguousarray(values[:, i]) for i in range(count)}
    return pa.table(table), decoded.kept


def _records(decoded: Decoded, part: List, kind: str) -> dict[str, Any]:
    """Return the columns of a list of records, one per field."""
    entries = decoded.entries(part.path, part.item)
    found: dict[str, Any] = {}
    for name, number, _ in part.item.fields:
        path = part.path if name == "value" and len(part.item.fields) == 1 else f"{part.path}.{name}"
        if number == _BYTES and path == part.path:
            if kind == "csv":
                found[f"{path}.size"] = np.array([len(rows) for rows in entries])
            else:
                found[path] = pa.array([rows[name].tobytes() for rows in entries], pa.binary())
            continue
        found |= _lists(path, [rows[name].ravel().tolist() for rows in entries], kind, pa.from_numpy_dtype(number))
    return found


def _lists(path: str, values: list[list[Any]], kind: str, entry: pa.DataType) -> dict[str, Any]:
    if kind == "csv":
        return {path: pa.array([json.dumps(value) for value in values], pa.string())}
    return {path: pa.array(values, pa.list_(entry))}


def _by_message(layout: Layout, batch: Batch) -> tuple[pa.Table | None, Rows]:
    """Return messages as a table of JSON, one column per top-level field, decoded one by one."""
    names = [name for name, _ in layout.store.fielddefs[layout.type][1]]
    kept: list[int] = []
    rows: dict[str, list[str]] = {name: [] for name in names}
    for number, (offset, length) in enumerate(zip(batch.offset.tolist(), batch.length.tolist(), strict=True)):
        try:
            message = layout.message(batch.data[offset : offset + length].tobytes())
        except MessageError:
            continue
        kept.append(number)
        for name in names:
            rows[name].append(json.dumps(_plain(getattr(message, name))))
    which = np.array(kept, np.int64)
    if not kept:
        return None, which
    fields = {name: pa.array(column, pa.string()) for name, column in rows.items()}
    return pa.table({_TIME: batch.time[which], **fields}), which


def _plain(value: Any) -> Any:
    """Return a field as plain data."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = "Convert a bag, also one truncated by a crash: " + "; ".join(
        f"{k}: {v}" for k, v in FORMATS.items()
    )
    add = parser.add_argument
    add("file", type=Path, help="ROS 1 bag, or ROS 2 bag")
    add("--to", choices=FORMATS, required=True, help="output format")
    add("--topics", nargs="+", metavar="TOPIC", help="only these topics; * and ? are wildcards (default: all)")
    add("--out", type=Path, metavar="PATH", help="new file or folder (default: next to the bag)")


def convert(file: Path, form: str, out: Path | None, topics: Sequence[str] | None) -> Iterator[str]:
    """Convert a recording, and yield status lines.

    Raises:
        OptionError: the target exists or cannot be written.
        BagError: nothing can be read.
    """
    source = open_source(file)
    target = out or file.with_name(f"{file.stem}-{form}" if form != "bag" else f"{file.stem}-whole.bag")
    if target.exists():
        raise OptionError(f"out: {str(target)!r} exists already; choose another --out")
    wanted = chosen(topics)
    losses = Losses()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if form in ("csv", "parquet"):
            target.mkdir()
            tables = to_tables(source, target, form, wanted, losses)
            if not tables:
                target.rmdir()
                raise BagError(_nothing(source, losses))
            yield f"{len(tables)} tables, {sum(rows for _, _, rows in tables)} rows"
        elif form == "bag":
            yield f"{rewrite(source, target, wanted, losses)} messages"
        else:
            to_ros2(source, target, "mcap" if form == "mcap" else "sqlite3", topics, losses)
            if form == "mcap":
                yield str(next(target.glob("*.mcap"), target))
    except OSError as error:
        raise OptionError(f"out: {str(target)!r} cannot be written: {error.strerror or error}") from error
    yield str(target)
    yield from (f"Note: {note}" for note in [*source.notes, *losses.notes()])


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    console = Console()
    try:
        for text in convert(arguments.file, arguments.to, arguments.out, arguments.topics):
            console.print(text, highlight=False, soft_wrap=True, markup=False)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except BagError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    return 0
