"""Files named by users, read with limits of size, values and depth, and result files that are whole or absent.

A file may be an endless device, a pipe without a writer, or a few lines that expand to gigabytes. Only regular files
are read, after a check of their size, and parsed content is limited to the number of values and the depth that the
formats of the callers need.

A result file is written under a temporary name and renamed at the end: a disk that fills up, or a program that is
killed, would otherwise leave the beginning of a file under its final name, in place of an earlier whole one.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

MB = 1 << 20
MOST_TEXT = 4 * MB
"""Default size limit of YAML, JSON and text files, bytes."""
MOST_VALUES = 200_000
"""Limit of the values of a YAML file and the elements of an XML file; an alias counts as all its values."""
MOST_JSON_VALUES = 500_000
MOST_DIGITS = 400
"""Limit of the characters of a number in YAML and JSON; the whole numbers beyond 1e308 are not allowed either."""
MOST_DEPTH = 100
"""Limit of the nesting of lists, mappings or elements."""
_MOST_BITS = 1023  # of a whole number


class ContentError(ValueError):
    """A malformed text or one with too many values; the message is one line with the position."""


def read_bytes(path: str | Path, most: int) -> bytes:
    """Return the content of a regular file.

    Args:
        path: the file; links are followed.
        most: largest size allowed, bytes.

    Raises:
        OSError: the file cannot be read, is not a regular file, or is larger; ``strerror`` gives the reason.
    """
    check(path, most)  # before opening: opening a pipe would wait for a writer
    with open(path, "rb") as file:
        _check(os.fstat(file.fileno()), path, most)
        data = file.read(most + 1)
    if len(data) > most:  # the file is growing
        raise _too_large(path, len(data), most)
    return data


def check(path: str | Path, most: int) -> None:
    """Check a file before another library opens it.

    Raises:
        OSError: see :func:`read_bytes`.
    """
    try:
        status = os.stat(path)
    except ValueError:
        raise OSError(errno.EINVAL, "a name with a NUL or an invalid character is not allowed", str(path)) from None
    _check(status, path, most)


def read_text(path: str | Path, most: int = MOST_TEXT) -> str:
    r"""Return the content of a regular file in UTF-8, without a byte order mark, with ``\n`` line endings.

    Args:
        path: the file; links are followed.
        most: largest size allowed, bytes.

    Raises:
        OSError: see :func:`read_bytes`.
        ContentError: the file is not UTF-8.
    """
    try:
        text = read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ContentError(f"byte {error.start} does not begin a UTF-8 character") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def load_yaml(text: str, loader: type[BoundedLoader] | None = None) -> Any:
    """Return the content of a YAML text, in the types of ``yaml.safe_load``.

    Args:
        text: the text.
        loader: a class derived from ``BoundedLoader``; None: that one.

    Raises:
        ContentError: the text is not valid YAML, or has too many values or a number that is too long.
    """
    try:
        return (loader or BoundedLoader)(text).get_single_data()
    except ContentError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ContentError(f"{_position(mark)}{error.problem or error.context}") from error
    except yaml.reader.ReaderError as error:
        raise ContentError(f"character {error.position}: {error.reason}") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # such as an impossible date
        raise ContentError(f"a value is not allowed: {type(error).__name__}") from error


def load_json(text: str, parse_constant: Callable[[str], Any] | None = None) -> Any:
    """Return the content of a JSON text.

    Args:
        text: the text.
        parse_constant: see ``json.loads``.

    Raises:
        ContentError: the text has too many values, is nested too deeply, or has a number that is too long.
        ValueError: the text is not valid JSON.
    """
    if text.count(",") + text.count("[") + text.count("{") > MOST_JSON_VALUES:  # each value has at least one
        raise ContentError(f"more than {MOST_JSON_VALUES} values")
    try:
        return json.loads(text, parse_constant=parse_constant, parse_int=_whole_number)
    except RecursionError:
        raise ContentError("nested too deeply") from None


def _whole_number(text: str) -> int:
    """Return a whole number that fits into a float; others could neither be converted nor printed.

    Raises:
        ContentError: it does not.
    """
    if len(text) <= MOST_DIGITS:
        number = int(text)
        if number.bit_length() <= _MOST_BITS:
            return number
    raise ContentError(f"a number of {len(text)} characters is not allowed, up to 1e308")


class BoundedLoader(yaml.SafeLoader):
    """Safe YAML loader with limits of values, depth and numbers."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._values = 0
        self._depth = 0
        self._sizes: dict[str | None, int] = {}  # number of values by anchor

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Return the next node, counted with its depth."""
        event = self.peek_event()
        anchor: str | None = getattr(event, "anchor", None)
        before = self._values
        if isinstance(event, yaml.AliasEvent):
            recursive = anchor in self.anchors and anchor not in self._sizes
            self._count(event, MOST_VALUES if recursive else self._sizes.get(anchor, 0))
            return super().compose_node(parent, index)
        self._count(event, 1)
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise ContentError(f"{_position(event.start_mark)}nested more than {MOST_DEPTH} deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None:
            self._sizes[anchor] = self._values - before
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """Return a whole number within the limits; numbers in base 60 take quadratic time."""
        self._check_length(node)
        number = int(super().construct_yaml_int(node))
        if number.bit_length() > _MOST_BITS:
            raise ContentError(f"{_position(node.start_mark)}a number of {len(node.value)} characters is not allowed")
        return number

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """Return a number within the limits."""
        self._check_length(node)
        return float(super().construct_yaml_float(node))

    def _check_length(self, node: yaml.ScalarNode) -> None:
        if len(node.value) > MOST_DIGITS:
            long = f"a number of {len(node.value)} characters is not allowed, {MOST_DIGITS} at most"
            raise ContentError(_position(node.start_mark) + long)

    def _count(self, event: yaml.Event, values: int) -> None:
        self._values += values
        if self._values > MOST_VALUES:
            raise ContentError(
                f"{_position(event.start_mark)}more than {MOST_VALUES} values, those of aliases included"
            )


BoundedLoader.add_constructor("tag:yaml.org,2002:int", BoundedLoader.construct_yaml_int)
BoundedLoader.add_constructor("tag:yaml.org,2002:float", BoundedLoader.construct_yaml_float)


def _position(mark: Any) -> str:
    return "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "


def _check(status: os.stat_result, path: str | Path, most: int) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    if status.st_size > most:
        raise _too_large(path, status.st_size, most)


def _too_large(path: str | Path, size: int, most: int) -> OSError:
    return OSError(errno.EFBIG, f"it has {size / MB:.1f} MB, at most {most / MB:g} MB are allowed", str(path))


_NAME_KEPT = 50  # characters: the name of the draft is not too long where that of the file is not


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path to write to; rename it to ``path`` at the end, or delete it if an exception is raised.

    Of a symbolic link the target is replaced. What is no regular file, such as /dev/stdout, is yielded itself.

    Raises:
        OSError: it cannot be written; the error names ``path``; a regular file has not changed.
    """
    try:
        if path.exists() and not path.is_file():
            yield path
            return
        target = Path(os.path.realpath(path))
        draft = _new_draft(target)
        try:
            yield draft
            os.replace(draft, target)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def _new_draft(target: Path) -> Path:
    """Create an empty file of its own beside ``target``, hidden, with the mode of new files."""
    draft = target.with_name(f".{target.name[:_NAME_KEPT]}.{secrets.token_hex(8)}.new")
    os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    return draft


def write_whole(path: str | Path, text: str) -> None:
    """Write a text file, UTF-8; see ``replacing``."""
    with replacing(Path(path)) as draft:
        draft.write_text(text, encoding="utf-8")


def shortened(text: str, most: int = 200) -> str:
    """Return a text for a message: its first ``most`` characters, with a mark if it is longer."""
    return text if len(text) <= most else f"{text[:most]}..."
