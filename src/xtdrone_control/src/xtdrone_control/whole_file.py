"""Files that are whole or absent: written under a temporary name, and renamed at the end.

A disk that fills up, or a program that is killed, would otherwise leave the beginning of a file under its final name,
in place of an earlier whole one.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

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
