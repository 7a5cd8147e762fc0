"""Files that are whole or absent, on a disk that fills up."""

from __future__ import annotations

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from xtdrone_control.whole_file import replacing, write_whole

LIMIT = 4096  # bytes of a file


@contextmanager
def full_disk() -> Iterator[None]:
    """Let no file of this process grow beyond LIMIT, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("earlier", ["", "an earlier report"])
def test_a_full_disk_leaves_what_was_there_and_names_the_file(tmp_path: Path, earlier: str) -> None:
    file = tmp_path / "report.json"
    if earlier:
        file.write_text(earlier)
    with full_disk(), pytest.raises(OSError, match=r"report\.json") as raised:
        write_whole(file, "x" * (2 * LIMIT))
    assert raised.value.filename == str(file)
    assert [path.read_text() for path in tmp_path.iterdir()] == [earlier] * bool(earlier)
    write_whole(file, "whole")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["whole"]


def test_an_exception_leaves_no_draft(tmp_path: Path) -> None:
    def fail() -> None:
        with replacing(tmp_path / "a.png") as draft:
            draft.write_text("half")
            raise KeyError("drawing")

    with pytest.raises(KeyError):
        fail()
    assert list(tmp_path.iterdir()) == []
