"""Files that are whole or absent: written under a temporary name, and renamed at the end.

A disk that fills up, or a program that is killed, would otherwise leave the beginning of a file under its final name,
in place of an earlier whole one.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

_DRAFT = ".new"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path to write to; rename it to ``path`` at the end, or delete it if an exception is raised.

    Raises:
        OSError: it cannot be written; the error names ``path``, on which nothing has changed.
    """
    draft = path.with_name(path.name + _DRAFT)
    try:
        try:
            yield draft
            os.replace(draft, path)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def write_whole(path: str | Path, text: str) -> None:
    """Write a text file, UTF-8; see ``replacing``."""
    with replacing(Path(path)) as draft:
        draft.write_text(text, encoding="utf-8")
