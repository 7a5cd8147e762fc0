"""Shapes for any number of vehicles."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from xtdrone_coordination.leader import CommandError, Leader
from xtdrone_coordination.patterns import (
    PatternError,
    Patterns,
    absolute_name,
    clouds,
    least_separation,
    parse_name,
    with_leader,
)
from xtdrone_coordination.patterns.slot_offsets_and_spacing import farthest

COUNTS = [*range(2, 34), 57, 100, 333, 1000, 1001]


def bumpy_cloud(count: int) -> np.ndarray:
    """Return a torus with noise, shape (count, 3), in units other than metres."""
    rng = np.random.default_rng(3)
    u, v = rng.uniform(0.0, 2.0 * np.pi, (2, count))
    radius = 0.05 + 0.02 * np.cos(v)
    return np.stack([radius * np.cos(u), radius * np.sin(u), 0.02 * np.sin(v)], axis=1) + 7.0


@pytest.fixture(scope="module")
def torus(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("cloud") / "torus.npy"
    np.save(file, bumpy_cloud(4000))
    return str(file)


@pytest.mark.parametrize("count", COUNTS)
def test_every_shape_fits_any_swarm(count: int, torus: str) -> None:
    names = {
        "grid": 3.0, "circle": 3.0, "sphere": 3.0, "sphere:spacing=4.5": 4.5, "text:XTD": 2.0, "text:i % Ä": 2.0,
        "text:.:spacing=3": 3.0, f"cloud:{torus}": 2.0, f"cloud:{torus}:spacing=10": 10.0, "cube:spacing=4": 4.0,
    }  # fmt: skip
    if count == 18:
        del names["sphere"]  # "sphere" is XTDrone's own
    patterns, again = Patterns(count), Patterns(count)
    for name, spacing in names.items():
        assert name in patterns
        offsets = patterns.offsets(name)
        assert offsets.shape == (count - 1, 3), name
        assert np.isfinite(offsets).all(), name
        assert least_separation(offsets) == pytest.approx(spacing, rel=1e-9), name
        assert np.array_equal(offsets, again.offsets(name)), f"{name}: not the same twice"


@pytest.mark.parametrize("count", [9, 30, 200, 1000])
def test_shapes_match_their_names(count: int) -> None:
    patterns = Patterns(count)
    grid = with_leader(patterns.offsets("grid"))
    assert np.allclose(grid / 3.0, np.round(grid / 3.0))
    assert (grid[:, 2] == 0.0).all()
    assert np.linalg.norm(grid, axis=1).max() < 1.2 * 3.0 * np.sqrt(count / 2.0), "no square around the leader"
    circle = with_leader(patterns.offsets("circle"))
    radius = np.linalg.norm(circle - circle.mean(axis=0), axis=1)
    assert np.ptp(radius) < 1e-6
    assert circle[:, 0].max() == 0.0, "the leader is ahead"
    gaps = np.linalg.norm(circle - np.roll(circle, 1, axis=0), axis=1)
    assert np.ptp(gaps) < 1e-6
    sphere = with_leader(patterns.offsets("sphere"))
    assert sphere[:, 2].max() == 0.0, "the leader is on top"
    system = np.c_[2.0 * sphere, np.ones(count)]  # |p|^2 = 2 c p + r^2 - |c|^2
    residual = np.linalg.lstsq(system, (sphere**2).sum(axis=1), rcond=None)[1]
    assert residual[0] < 1e-9 * count * np.ptp(sphere) ** 4
    distances = np.linalg.norm(sphere[:, None] - sphere[None], axis=-1) + np.diag(np.full(count, np.inf))
    nearest = distances.min(axis=1)
    assert nearest.max() < 1.6 * nearest.min(), "not evenly covered"


def test_letters_stand_upright_below_the_leader() -> None:
    text = with_leader(Patterns(30).offsets("text:L"))
    assert (text[:, 1] == 0.0).all()
    assert text[:, 2].max() <= 0.1 * np.ptp(text[:, 2])
    x, z = text[:, 0] - text[:, 0].min(), text[:, 2] - text[:, 2].min()
    upright, foot = x < 0.25 * x.max(), z < 0.25 * z.max()
    assert (upright | foot).all(), "an L has an upright on its left and a foot"
    assert upright.sum() > 10
    assert foot.sum() > 5


def test_letters_follow_each_other_to_the_right() -> None:
    one, two = Patterns(200).offsets("text:I-"), Patterns(200).offsets("text:-I")
    for offsets, left in ((one, True), (two, False)):
        x, z = with_leader(offsets)[:, 0], with_leader(offsets)[:, 2]
        foot = z < 0.9 * z.min()  # of the I alone
        assert bool(x[foot].mean() < x.mean()) is left


def test_many_vehicles_fill_the_letters_and_few_line_them() -> None:
    few, many = (with_leader(Patterns(n).offsets("text:I")) for n in (8, 1000))
    assert np.ptp(few[:, 0]) == pytest.approx(0.0, abs=1e-9)
    assert len(np.unique(many[:, 0].round(1))) > 10


def test_a_hole_remains_open() -> None:
    ring = with_leader(Patterns(1000).offsets("text:O"))
    middle = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
    assert np.linalg.norm(ring - middle, axis=1).min() > 0.2 * np.ptp(ring[:, 2])


def test_a_font_of_ones_own() -> None:
    import matplotlib

    bold = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans-Bold.ttf"
    patterns = Patterns(100)
    assert not np.allclose(patterns.offsets(f"text:A:font={bold}"), patterns.offsets("text:A"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("text", "text needs WORDS, as text:XTD"),
        ("text:", "text needs WORDS"),
        ("text: ", "1 to 100 printable"),
        ("text:a\nb", "1 to 100 printable"),
        ("text:" + "x" * 101, "1 to 100 printable"),
        ("text:漢字", "has no 漢 字"),
        ("text:A:font=/nowhere.ttf", "font /nowhere.ttf: No such file"),
        ("text:A:font=/etc/passwd", "font /etc/passwd: .*unknown file format"),
        ("text:A:fnt=/x.ttf", "option 'fnt' is unknown for text; there are: spacing, font"),
        ("circle:7", "'7' is not allowed after circle"),
        ("circle:font=x", "option 'font' is unknown for circle; there are: spacing"),
        ("sphere:spacing=nan", "spacing: 'nan' is not allowed, 0.5 to 1000 m"),
        ("sphere:spacing=0.4", "spacing: '0.4'"),
        ("sphere:spacing=", "spacing: ''"),
        ("sphere:spacing=3:4", "spacing: '3:4'"),
        ("cube:spacing=-2", "spacing: '-2'"),
        ("cloud", "cloud needs FILE"),
        ("cloud:/nowhere.ply", "cloud /nowhere.ply: No such file"),
        ("cloud:/", "cloud /: Is a directory"),
        ("heart", "pattern 'heart' is unknown for 9 vehicles.*circle.*text:WORDS, cloud:FILE"),
        ("heart:spacing=2", "pattern 'heart:spacing=2' is unknown for 9"),
    ],
)
def test_wrong_names_are_explained(name: str, message: str) -> None:
    with pytest.raises(PatternError, match=message):
        Patterns(9).offsets(name)


def test_names_are_parsed() -> None:
    request = parse_name("text:12:30 a=b:font=/a:b.ttf:spacing=2.5")
    assert (request.kind, request.argument, request.font, request.spacing) == ("text", "12:30 a=b", "/a:b.ttf", 2.5)
    assert str(request) == "text:12:30 a=b:font=/a:b.ttf:spacing=2.5"
    assert parse_name("text:x=1").argument == "x=1", "the argument may look like an option"


def test_files_in_names_get_their_whole_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")
    for name, whole in {
        "cube": "cube", "text:XTD": "text:XTD", "text": "text", "circle:spacing=x": "circle:spacing=x",
        "cloud:a.ply": f"cloud:{tmp_path}/a.ply", "cloud:/a.ply:spacing=3": "cloud:/a.ply:spacing=3",
        "cloud:~/a.ply": "cloud:/home/me/a.ply",
        "text:A:font=b.ttf:spacing=2.25": f"text:A:font={tmp_path}/b.ttf:spacing=2.25",
    }.items():  # fmt: skip
        assert absolute_name(name) == whole


def test_xtdrones_own_sphere_is_kept_and_can_be_scaled() -> None:
    patterns = Patterns(18)
    assert patterns.offsets("sphere")[3].tolist() == [12.0, 0.0, 0.0]
    assert np.allclose(patterns.offsets("sphere:spacing=9"), patterns.offsets("sphere") * 9 / 4.592, rtol=1e-3)


# clouds

PLACES = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [0.0, 2.0, 0.25], [4.0, 4.0, 4.0]]


def ply(order: str, rows: bytes, count: int = 4, before: str = "") -> bytes:
    header = (
        f"ply\nformat {order} 1.0\ncomment made by hand\n{before}element vertex {count}\nproperty uchar red\n"
        "property float x\nproperty double y\nproperty float32 z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + rows


def packed(byte_order: str) -> bytes:
    return b"".join(struct.pack(f"{byte_order}Bfdf", 255, *row) for row in PLACES) + b"\x03" + bytes(12)


TEXT_ROWS = "".join(f"255 {x} {y} {z}\n" for x, y, z in PLACES).encode() + b"3 0 1 2\n"
FILES = {
    "a.ply": ply("ascii", TEXT_ROWS),
    "crlf.ply": ply("ascii", TEXT_ROWS).replace(b"\n", b"\r\n"),
    "little.ply": ply("binary_little_endian", packed("<")),
    "big.PLY": ply("binary_big_endian", packed(">")),
    "a.xyz": b"# a remark\n0 0 0\n1 0 .5 \n\n0\t2 0.25 # here\n  4 4 4 99\n",
    "a.csv": b"x,y,z,intensity\n0,0,0,1\n1, 0, 0.5,1\n0,2,0.25,1\n4,4,4,1\n",
    "semicolon.csv": b"0;0;0\n1;0;.5\n0;2;.25\n4;4;4\n",
}


@pytest.mark.parametrize("name", FILES)
def test_clouds_are_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(FILES[name])
    assert clouds.read_cloud(tmp_path / name).tolist() == PLACES
    offsets = Patterns(4).offsets(f"cloud:{tmp_path / name}")
    points = with_leader(offsets)
    scale = 2.0 / np.linalg.norm(np.array(PLACES[1]) - PLACES[0])
    wanted = scale * (np.array(PLACES) - PLACES[3])  # the highest is the leader
    assert np.allclose(sorted(points.tolist()), sorted(wanted.tolist()))


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.ply", b"solid", "not a PLY file"),
        ("a.ply", ply("ascii", b"255 0 0 0\n"), "ends before its 4 vertices of 4 numbers"),
        ("a.ply", ply("binary_little_endian", packed("<")[:40]), "ends before its 4 vertices of 17 bytes"),
        ("a.ply", ply("morse", b""), "no known format"),
        (
            "a.ply",
            ply("ascii", b"", before="element face 3\nproperty list uchar int i\n"),
            "another element precedes the vertices",
        ),
        ("a.ply", ply("ascii", TEXT_ROWS).replace(b"float x", b"float w"), "x, y and z are needed"),
        (
            "a.ply",
            ply("ascii", TEXT_ROWS).replace(b"double y", b"list uchar int y"),
            "line 7: this property of a vertex is not allowed",
        ),
        ("a.ply", ply("ascii", TEXT_ROWS.replace(b"4.0 4.0", b"4.0 north")), "vertex 3: not three numbers"),
        ("a.xyz", b"0 0 0\n1 2\n", "line 2: does not begin with three numbers"),
        ("a.xyz", b"0 0 0\n1 nan 2\n", "point 1 is not finite"),
        ("a.xyz", b"\xff\xfe\x00", "cloud .*a.xyz"),
        ("a.csv", b"x,y,z\n", "has no points"),
        ("a.npy", b"", "cloud .*a.npy"),
        ("a.xyz", b"0 0 0\n1 1 1\n0 0 0\n", "2 different points, 3 vehicles need at least 3"),
    ],
)
def test_bad_clouds_are_explained(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(PatternError, match=message):
        Patterns(3).offsets(f"cloud:{tmp_path / name}")


@pytest.mark.parametrize("values", [np.zeros(3), np.zeros((3, 2)), np.array([["a", "b", "c"]])])
def test_arrays_of_another_shape_are_rejected(tmp_path: Path, values: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(PatternError, match=r"\(points, 3\) of numbers is needed"):
        Patterns(3).offsets(f"cloud:{tmp_path / 'a.npy'}")


def test_a_cloud_is_covered_as_a_whole(torus: str) -> None:
    points = clouds.read_cloud(Path(torus))
    chosen = points[farthest(points, 200)]
    distances = np.linalg.norm(points[:, None] - chosen[None], axis=-1).min(axis=1)
    between = np.linalg.norm(chosen[:, None] - chosen[None], axis=-1)[np.triu_indices(200, 1)]
    assert distances.max() <= between.min() + 1e-12, "each choice was the farthest point"


def test_a_large_cloud_is_thinned_first(tmp_path: Path) -> None:
    np.save(tmp_path / "large.npy", bumpy_cloud(120_000))
    name = f"cloud:{tmp_path / 'large.npy'}"
    assert np.array_equal(Patterns(50).offsets(name), Patterns(50).offsets(name))


def test_followers_load_neither_matplotlib_nor_scipy() -> None:
    code = (
        "import sys; from xtdrone_coordination.follower import Follower; from xtdrone_coordination.patterns import *;"
        "Follower(1, 500).on_pattern(Patterns(500).offsets('sphere'));"
        "print({'scipy', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "set()"


# files named by other files


SECRET = b"salt:$6$salt$salt:19000::::::\n"


@pytest.mark.parametrize("name", ["secret", "secret.xyz", "secret.ply", "secret.npy"])
@pytest.mark.parametrize("head", [b"", b"0 0 0\n", b"ply\nformat ascii 1.0\nelement vertex 3\n", b"\x93NUMPY\1\0"])
def test_contents_of_a_file_never_appear_in_messages(tmp_path: Path, name: str, head: bytes) -> None:
    for tail in (b"", b"property float x\nproperty float y\nproperty float z\nend_header\n0 0 "):
        (tmp_path / name).write_bytes(head + tail + SECRET)
        with pytest.raises(PatternError, match=f"cloud .*{name}: ") as caught:
            Patterns(3).offsets(f"cloud:{tmp_path / name}")
        assert "salt" not in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("option", ["cloud:{}", "text:A:font={}"])
def test_files_without_an_end_are_rejected(tmp_path: Path, option: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "large.ply").open("wb") as file:
        file.truncate(1 << 30)
    words = {"/dev/zero": "it is not a regular file", tmp_path / "pipe": "it is not a regular file",
             tmp_path / "large.ply": "it has 1024.0 MB, at most"}  # fmt: skip
    for file, said in words.items():
        with pytest.raises(PatternError, match=said):
            Patterns(3).offsets(option.format(file))


def test_text_of_too_many_points_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds, "MAX_TEXT_POINTS", 3)
    (tmp_path / "a.xyz").write_bytes(FILES["a.xyz"])
    (tmp_path / "a.ply").write_bytes(FILES["a.ply"])
    with pytest.raises(PatternError, match="line 6: more than 3 points"):
        Patterns(3).offsets(f"cloud:{tmp_path / 'a.xyz'}")
    with pytest.raises(PatternError, match="4 points as text, at most 3 are allowed"):
        Patterns(3).offsets(f"cloud:{tmp_path / 'a.ply'}")


def test_an_array_larger_than_its_file_is_rejected(tmp_path: Path) -> None:
    file = tmp_path / "a.npy"
    np.save(file, np.zeros((9, 3)))
    file.write_bytes(file.read_bytes().replace(b"(9, 3), }" + b" " * 12, b"(9" + b"0" * 12 + b", 3), }"))
    with pytest.raises(PatternError, match="has an array of another type or size"):
        Patterns(3).offsets(f"cloud:{file}")


def test_files_over_topics_lie_below_a_folder(tmp_path: Path) -> None:
    inside, outside = tmp_path / "clouds", tmp_path / "clouds-of-others"
    for folder in (inside, outside):
        folder.mkdir()
        (folder / "a.xyz").write_bytes(FILES["a.xyz"])
    (inside / "way_out").symlink_to(outside)
    (inside / "link.xyz").symlink_to(inside / "a.xyz")
    (tmp_path / "also").symlink_to(inside)
    patterns = Patterns(4, below=inside, given=[f"cloud:{outside}/a.xyz:spacing=3"])
    for name in ("a.xyz", "./a.xyz", "link.xyz", inside / "a.xyz", tmp_path / "also" / "a.xyz", "../clouds/a.xyz"):
        assert patterns.offsets(f"cloud:{name}").shape == (3, 3)
    for name in ("../clouds-of-others/a.xyz", outside / "a.xyz", "way_out/a.xyz", "/etc/passwd", "~/a.xyz/../../../x"):
        with pytest.raises(PatternError, match=f"is not allowed, a file below {inside} is"):
            patterns.offsets(f"cloud:{name}")
    with pytest.raises(PatternError, match="is not allowed, a file below"):
        patterns.offsets("text:A:font=/usr/share/fonts/a.ttf")
    assert patterns.offsets(f"cloud:{outside}/a.xyz:spacing=3").shape == (3, 3)  # listed at the start
    assert patterns.offsets("text:A").shape == (3, 3)


def test_topics_read_no_file_without_a_configured_folder(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_bytes(FILES["a.xyz"])
    leader = Leader(4, Patterns(4, below=""))
    for name in (f"cloud:{tmp_path / 'a.xyz'}", "cloud:/etc/shadow", "cloud:", f"text:A:font={tmp_path}"):
        with pytest.raises(CommandError, match=r"no file may be read; name a folder|cloud needs FILE"):
            leader.on_command(name)
