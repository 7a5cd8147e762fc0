"""Folders of generated files in the user's cache, each created once, by one of several processes."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path


def cached_folder(kind: str, name: str, write: Callable[[Path], None]) -> Path:
    """Return a folder below ``$XDG_CACHE_HOME`` (else ``~/.cache``), which is created atomically.

    Args:
        kind: kind of the caller's files, the name of the folders' common parent.
        name: of the folder; it must change with the content.
        write: writes the files into an empty folder.

    Raises:
        OSError: the cache cannot be written.
    """
    above = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "xtdrone" / kind
    folder = above / name
    if folder.is_dir():
        return folder
    above.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=above))
    try:
        write(fresh)
        fresh.chmod(0o755)
        fresh.rename(folder)
    except OSError:
        shutil.rmtree(fresh, ignore_errors=True)
        if not folder.is_dir():  # else another process was faster
            raise
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    return folder
