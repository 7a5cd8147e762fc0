"""Files that are whole or absent, on a disk that fills up."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from xtdrone_common.files import replacing, write_whole

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


def test_files_beside_are_kept_and_writers_do_not_share_a_draft(tmp_path: Path) -> None:
    file, other = tmp_path / "a.plan", tmp_path / "a.plan.new"
    other.write_text("the user's")
    with replacing(file) as first, replacing(file) as second:
        assert first.parent == tmp_path
        assert len({first, second, other}) == 3
        first.write_text("first")
        second.write_text("second")
    assert (file.read_text(), other.read_text()) == ("first", "the user's")
    assert sorted(tmp_path.iterdir()) == [file, other]
    assert file.stat().st_mode == other.stat().st_mode


@pytest.mark.parametrize("exists", [True, False])
def test_the_target_of_a_link_is_replaced(tmp_path: Path, exists: bool) -> None:
    (tmp_path / "store").mkdir()
    target, link = tmp_path / "store" / "a", tmp_path / "link"
    if exists:
        target.write_text("old")
    link.symlink_to("store/a")
    write_whole(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert list(target.parent.iterdir()) == [target]


def test_a_pipe_is_written_to() -> None:
    reading, writing = os.pipe()
    write_whole(f"/dev/fd/{writing}", "text")
    os.close(writing)
    with open(reading, encoding="utf-8") as pipe:
        assert pipe.read() == "text"
