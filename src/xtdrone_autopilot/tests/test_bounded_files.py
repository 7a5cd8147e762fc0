"""Endless files, pipes and texts that expand: rejected with a message, at once and without filling the memory."""

from __future__ import annotations

import os
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from xtdrone_autopilot.parameters import parameter_file
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_common import files
from xtdrone_common.files import MB, MOST_VALUES, ContentError, load_json, load_yaml, read_bytes, read_text

BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(f'*{before}' for _ in range(10))}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.fixture
def bounded() -> Iterator[None]:
    """Fail a test that uses 64 MB of memory or 20 s of CPU time."""
    tracemalloc.start()
    begin = time.process_time()
    yield
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 64 * MB
    assert time.process_time() - begin < 20.0


def sparse(path: Path) -> Path:
    with path.open("wb") as file:
        file.truncate(1 << 30)
    return path


@pytest.mark.usefixtures("bounded")
def test_a_large_file_is_rejected_by_its_size(tmp_path: Path) -> None:
    file = sparse(tmp_path / "large")
    with pytest.raises(OSError, match=r"it has 1024.0 MB, at most 4 MB are allowed"):
        read_text(file)
    with pytest.raises(qgc_plan.PlanError, match=r"large: cannot be read: it has 1024\.0 MB, at most 16 MB"):
        qgc_plan.read(file)
    assert parameter_file.read_rows(file) == []


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("kind", ["device", "pipe", "link"])
def test_special_files_are_rejected_without_opening_them(tmp_path: Path, kind: str) -> None:
    path = tmp_path / kind
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to("/dev/zero")
    else:
        path = Path("/dev/zero")
    with pytest.raises(OSError, match="it is not a regular file"):
        read_bytes(path, MB)


def test_folders_and_missing_files_are_distinguished(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError, match="Is a directory"):
        read_bytes(tmp_path, MB)
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "none", MB)


def test_text_is_read_as_path_reads_it(tmp_path: Path) -> None:
    file = tmp_path / "text"
    file.write_bytes("a\r\nä\rb\n".encode())
    assert read_text(file) == file.read_text(encoding="utf-8")
    assert read_bytes(file, file.stat().st_size) == file.read_bytes()
    with pytest.raises(OSError, match="at most"):
        read_bytes(file, file.stat().st_size - 1)
    file.write_bytes(b"ab\xff")
    with pytest.raises(ContentError, match="byte 2 does not begin a UTF-8 character"):
        read_text(file)


@pytest.mark.parametrize("file", sorted(Path(__file__).parents[2].glob("*/config/**/*.yaml")), ids=lambda p: p.name)
def test_our_files_are_read_as_yaml_reads_them(file: Path) -> None:
    text = read_text(file)
    assert load_yaml(text) == yaml.safe_load(text)


@pytest.mark.parametrize("text", ["", "1", "a: &x [1, 2]\nb: *x\n", "base: &b {k: 1}\nd: {<<: *b, l: 2}\n"])
def test_aliases_are_read_as_yaml_reads_them(text: str) -> None:
    assert load_yaml(text) == yaml.safe_load(text)


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, f"line 6, column [0-9]+: more than {MOST_VALUES} values, those of aliases included"),
        ("a: &a [*a]", "more than"),
        ("[" * 300, "line 1, column 101: nested more than 100 deep"),
        ("- " * 300, "line 1, column 201: nested more than 100 deep"),
        ("a: [1, 2\nb: 3\n", "^line 2, column 2: "),
        ("a: *b", "^line 1, column 4: found undefined alias"),
        ("2001-99-99", "^a value is not allowed: ValueError$"),
        ("{[1]: 2}", "^line 1, column 2: found unhashable key$"),
        ("a\0b", "^character 1: special characters are not allowed$"),
        ("!!python/object:os.system x", "^line 1, column 1: could not determine a constructor"),
    ],
)
def test_invalid_yaml_is_reported_in_one_line(text: str, words: str) -> None:
    with pytest.raises(ContentError, match=words) as caught:
        load_yaml(text)
    assert "\n" not in str(caught.value)


def test_too_many_values_are_rejected_before_construction(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MOST_VALUES", 1000)
    with pytest.raises(ContentError, match="more than 1000 values"):
        load_yaml("[" + "1, " * 1001)  # the end of the text is not parsed
    assert len(load_yaml("[" + "1, " * 999 + "]")) == 999


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 400_000, "nested too deeply"),
        ("[" + "[]," * 600_000, "more than 500000 values"),
        ('{"a": 1', "Expecting"),
    ],
)
def test_invalid_json_is_reported(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load_json(text)
    with pytest.raises(qgc_plan.PlanError, match=f"plan: is not JSON: .*{words}"):
        qgc_plan.parse(text)


@pytest.mark.parametrize(
    "number", ["9" * 5000, "-" + "9" * 310, "0x" + "f" * 5000, "0x" + "f" * 300, "1" + ":59" * 5000]
)
def test_numbers_that_fit_into_no_float_are_rejected(number: str, bounded: None) -> None:
    """Python neither prints a whole number of more than 4300 digits nor converts one beyond 1.8e308 to a float."""
    with pytest.raises(ContentError, match=r"a number of [0-9]+ characters is not allowed"):
        load_yaml(f"a: {number}")
    if number.lstrip("-").isdecimal():
        with pytest.raises(ContentError, match=r"a number of [0-9]+ characters is not allowed"):
            load_json(f"[{number}]")
    assert load_yaml("[0x10, 1_000, 1:30, 1e3, -7, .5]") == [16, 1000, 90, "1e3", -7, 0.5]
    assert load_json("[12345678901234567890, -7]") == [12345678901234567890, -7]


def test_a_name_with_nul_is_an_error_of_the_system(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="a name with a NUL"):
        read_bytes(tmp_path / "a\0b", MB)
    rows = tmp_path / "long.params"
    rows.write_text(f"{'9' * 5000}\t1\tMPC_XY_VEL_MAX\t5.0\t9\n")
    with pytest.raises(parameter_file.ParameterFileError, match=r"vehicle id '9+' is not allowed"):
        parameter_file.read(rows)
