"""Formation patterns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from xtdrone_coordination.patterns import PatternError, Patterns, least_separation, origin_columns
from xtdrone_coordination.patterns.clouds import read_cloud


@pytest.mark.parametrize(
    ("count", "names"),
    [
        (6, {"origin": 3.0, "T": 2.0, "diamond": 3.46, "triangle": 2.12}),
        (9, {"origin": 3.0, "cube": 3.46, "pyramid": 3.46, "triangle": 2.0}),
        (18, {"origin": 3.0, "cuboid": 4.0, "sphere": 4.59, "diamond": 3.46}),
    ],
)
def test_xtdrones_own_patterns(count: int, names: dict[str, float]) -> None:
    patterns = Patterns(count)
    assert patterns.names[: len(names)] == tuple(names)
    for name, expected in names.items():
        assert least_separation(patterns.offsets(name)) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("count", [*range(2, 41), 100, 250])
def test_generated_patterns_fit_any_swarm(count: int) -> None:
    patterns = Patterns(count)
    for name in ("origin", "cube", "pyramid", "triangle"):
        offsets = patterns.offsets(name)
        assert offsets.shape == (count - 1, 3)
        assert least_separation(offsets) >= 2.0 - 1e-9


def test_generated_families_resemble_xtdrones() -> None:
    def rows(offsets: np.ndarray) -> set[tuple[float, ...]]:
        return {tuple(row) for row in offsets.tolist()}

    from xtdrone_coordination.patterns import generated as module

    own = Patterns(9)
    for name in ("origin", "cube", "triangle"):
        assert rows(module.FAMILIES[name](9)) == rows(own.offsets(name))
    assert rows(module.FAMILIES["pyramid"](5)) == rows(own.offsets("pyramid")[:4])
    for count in (6, 9, 18):
        assert rows(module.FAMILIES["origin"](count)) == rows(Patterns(count).offsets("origin"))
    assert (origin_columns(6), origin_columns(9), origin_columns(18)) == (2, 3, 3)


def test_offsets_are_a_copy() -> None:
    patterns = Patterns(9)
    patterns.offsets("cube")[0] = 99.0
    assert patterns.offsets("cube").max() == 2.0


def test_unknown_name_lists_the_known() -> None:
    with pytest.raises(PatternError, match=r"'cuboid' is unknown for 9 vehicles.*origin, cube, pyramid, triangle"):
        Patterns(9).offsets("cuboid")


@pytest.mark.parametrize("count", [1, 0, -3])
def test_a_formation_has_two(count: int) -> None:
    with pytest.raises(PatternError, match="at least 2"):
        Patterns(count)


def test_users_file_adds_and_replaces(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("3:\n  line: [[2, 0, 0], [4, 0, 0]]\n  cube: [[0, 0, 5], [0, 0, 9]]\n4: {}\n")
    patterns = Patterns(3, file)
    assert "line" in patterns
    assert patterns.offsets("line").tolist() == [[2, 0, 0], [4, 0, 0]]
    assert patterns.offsets("cube")[1, 2] == 9.0
    assert "line" not in Patterns(4, file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("3: {line: [[2, 0, 0]]}", r"'line'.*size 1 x 3, but 3 vehicles need 2 x 3"),
        ("3: {line: [[2, 0, 0], [1, 2]]}", r"'line'.*three numbers"),
        ("3: {line: [[2, 0, 0], [.nan, 0, 0]]}", "finite"),
        ("3: {line: [[2, 0, 0], [2.1, 0, 0]]}", r"0\.10 m apart"),
        ("3: {line: [[0, 0, 0], [2, 0, 0]]}", r"0\.00 m apart"),
        ("3: [1, 2]", "entry 3"),
        ("vee: [[2, 0, 0], [4, 0, 0]]", "'vee' is not a number of vehicles"),
        ("'3': {line: [[2, 0, 0], [4, 0, 0]]}", "'3' is not a number of vehicles"),
        ("- 3", "number of vehicles"),
        ("3: {line: [[", "not YAML"),
    ],
)
def test_bad_files_are_explained(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(PatternError, match=message):
        Patterns(3, file)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(PatternError, match=r"nowhere\.yaml"):
        Patterns(3, tmp_path / "nowhere.yaml")


def test_patterns_are_generated_on_first_use(monkeypatch: pytest.MonkeyPatch) -> None:
    from xtdrone_coordination.patterns import generated as module

    made: list[str] = []
    for name, generate in module.FAMILIES.items():
        monkeypatch.setitem(
            module.FAMILIES, name, lambda count, name=name, generate=generate: made.append(name) or generate(count)
        )
    patterns = Patterns(1000)
    assert "cube" in patterns
    assert "cube" in patterns.describe()
    assert made == []
    patterns.offsets("cube")
    patterns.offsets("cube")
    assert made == ["cube"]


@pytest.mark.parametrize("count", [2, 3, 10, 300])
@pytest.mark.parametrize("kind", ["random", "lattice", "line", "plane", "twins", "clusters"])
def test_least_separation_is_that_of_all_pairs(count: int, kind: str) -> None:
    rng = np.random.default_rng(count)
    offsets = rng.uniform(-20.0, 20.0, (count - 1, 3))
    if kind == "lattice":
        offsets = np.round(offsets) + 0.25
    elif kind == "line":
        offsets[:, 1:] = 0.0
    elif kind == "plane":  # across the line along which points are ordered
        offsets -= np.outer(offsets @ [0.7834, 0.5283, 0.3271], [0.7834, 0.5283, 0.3271])
    elif kind == "twins":
        offsets[-1] = 1e-3
    elif kind == "clusters":
        offsets = np.round(offsets / 20.0) * 1000.0 + 0.01 * offsets
    points = np.vstack([np.zeros(3), offsets])
    pairs = np.linalg.norm(points[:, None] - points[None], axis=-1)[np.triu_indices(count, 1)]
    assert least_separation(offsets) == pairs.min()


def test_large_patterns_are_checked_without_all_pairs() -> None:
    import tracemalloc

    from xtdrone_coordination.patterns import check_offsets

    offsets = Patterns(5000).offsets("cube")
    tracemalloc.start()
    check_offsets(offsets, 5000, "large")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000, "all pairs would be 600 MB"


@pytest.mark.parametrize("count", [9, 200])
@pytest.mark.parametrize("name", ["circle", "cube", "pyramid", "text:XTD", "sphere"])
def test_the_least_spacing_travels_as_32_bit_floats(count: int, name: str) -> None:
    from xtdrone_coordination.patterns import check_offsets

    sent = Patterns(count).offsets(f"{name}:spacing=0.5").astype(np.float32)
    check_offsets(sent, count, name)
    with pytest.raises(PatternError, match=r"0\.50 m apart"):
        check_offsets(0.999 * sent, count, name)


def npy(header: bytes, data: bytes = b"") -> bytes:
    """Return an .npy file of version 1 with a header, which numpy would evaluate."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


@pytest.mark.parametrize(
    "content",
    [
        b"", b"\x93NUMPY", npy(b"("), npy(b"(" * 5000), npy(b"[" * 9000), npy(b"'" * 3), npy(b"\0" * 64),
        npy(b"-" * 9000 + b"1"),
        npy(b"{'descr': 'O', 'fortran_order': False, 'shape': (3, 3)}\n", bytes(72)),
        npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"9" * 5000 + b", 3)}\n"),
        npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-3, -3)}\n", bytes(72)),
        npy(b"{'descr': ('<f8', (2, 2)), 'fortran_order': False, 'shape': (3, 3)}\n", bytes(720)),
        npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (True, 3)}\n", bytes(8)),
        npy(b"{'descr': [('a', '<f8')], 'fortran_order': None, 'shape': None}\n"),
    ],
)  # fmt: skip
def test_damaged_arrays_are_errors_of_the_pattern(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cloud.npy"
    path.write_bytes(content)
    with pytest.raises(PatternError, match=r"cloud .*cloud\.npy"):
        read_cloud(path)


@pytest.mark.parametrize("name", ["a\0b.npy", "a\0b.ply", "a\0b.txt", "a" * 300 + ".npy"])
def test_impossible_names_of_clouds_are_errors_of_the_pattern(name: str, tmp_path: Path) -> None:
    with pytest.raises(PatternError):
        read_cloud(tmp_path / name)
