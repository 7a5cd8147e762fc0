"""The picture of a swarm: positions of drawn objects, films, bad input."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from xtdrone_coordination.laws.topology import veteran_topology
from xtdrone_coordination.patterns import Patterns, with_leader
from xtdrone_swarm import Swarm
from xtdrone_swarm.view import (
    FilmError,
    FilmWriter,
    Frame,
    SwarmView,
    Window,
    WindowError,
    can_open,
    check_film,
    film,
    palette,
)
from xtdrone_swarm.view import view_of_swarm as flight_module
from xtdrone_swarm.view.projection_and_zoom import FollowingBox
from xtdrone_swarm.view.view_of_swarm import _flying, _Player, _replay
from xtdrone_swarm.view.walls_and_scales import grid_step

UP = np.array([0.0, 0.0, 20.0])  # m
EAST = np.array([1.0, 0.0, 0.0])
HEIGHT = 600  # pixels; at this height sizes in the code are pixels


def make_view(count: int = 9, **options) -> SwarmView:
    return SwarmView([f"iris_{i}" for i in range(count)], **{"size": (800, HEIGHT), **options})


def formation(count: int, pattern: str = "cube", time: float = 0.0, title: str = "") -> Frame:
    slots = with_leader(Patterns(count).offsets(pattern)) + UP
    return Frame(time, slots, slots, np.argwhere(veteran_topology(slots) > 0), title or pattern)


def flight(count: int = 9, number: int = 20, fps: float = 10.0) -> Iterator[Frame]:
    """Return frames of vehicles on their way from the spawn grid into the cube."""
    slots = with_leader(Patterns(count).offsets("cube")) + UP
    start = with_leader(Patterns(count).offsets("origin")) + UP
    edges = np.argwhere(veteran_topology(slots) > 0)
    for k in range(number):
        share = k / max(1, number - 1)
        yield Frame(k / fps, start + share * (slots - start), slots, edges, "cube")


def at(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the colour, 0 to 1, at a place in pixels with y upwards."""
    return picture[picture.shape[0] - 1 - int(place[1]), int(place[0]), :3] / 255.0


def nearest_vehicle(colour: np.ndarray, colours: np.ndarray) -> int:
    """Return the vehicle of this colour; far vehicles are paler by up to 0.4."""
    pale = np.linspace(0.0, 0.42, 15)[:, None, None]
    return int(np.abs(colours + pale * (1.0 - colours) - colour).max(axis=2).min(axis=0).argmin())


# ---- positions in the picture ----


@pytest.mark.parametrize(("azimuth", "elevation", "zoom"), [(0, 0, 1), (70, 35, 1), (0, -60, 1), (-130, 5, 0.7)])
def test_each_vehicle_is_drawn_where_its_projection_is(azimuth, elevation, zoom):
    view = make_view(9, edges=False)
    view.camera.turn(azimuth, elevation)
    view.camera.magnify(zoom)
    frame = formation(9)
    view.update(frame)
    picture = view.draw()
    for i, place in enumerate(view.projection.pixels(frame.positions)):
        others = np.delete(view.projection.pixels(frame.positions), i, axis=0)
        if i == 0 or np.hypot(*(others - place).T).min() > 40.0:  # the leader is in front of all
            assert nearest_vehicle(at(picture, place), view.colours) == i


def test_marks_are_centred_on_their_vehicles():
    view = make_view(60, edges=False, slots=False, trails=0.0)
    frame = formation(60, "triangle")
    view.camera.turn(50.0, 0.0)
    view.update(frame)
    picture = view.draw()[..., :3].astype(float)
    for i in (17, 30, 59):
        x, y = view.projection.pixels(frame.positions[i])
        row, column = round(HEIGHT - y), round(x)
        part = 255.0 - picture[row - 12 : row + 12, column - 12 : column + 12].min(axis=2)
        weight = np.where(part > 90.0, 1.0, 0.0)
        rows, columns = np.mgrid[row - 12 : row + 12, column - 12 : column + 12] + 0.5
        assert abs((rows * weight).sum() / weight.sum() - (HEIGHT - y)) < 1.0
        assert abs((columns * weight).sum() / weight.sum() - x) < 1.0


def test_the_projection_has_equal_scales_and_east_is_right_seen_from_the_south_above():
    view = make_view(2)
    view.update(Frame(0.0, np.array([[0.0, 0.0, 10.0], [6.0, 0.0, 10.0]])))
    view.camera.azimuth, view.camera.elevation = -90.0, 89.0
    middle = view.box.middle
    origin, east, north = view.projection.pixels(middle + np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]))
    assert east - origin == pytest.approx([0.1 * view.projection.scale, 0.0], abs=0.02)
    assert north - origin == pytest.approx([0.0, 0.1 * view.projection.scale], abs=0.02)
    view.camera.elevation = 0.0
    up = view.projection.pixels(middle + np.array([0.0, 0.0, 0.1])) - view.projection.pixels(middle)
    assert up == pytest.approx([0.0, 0.1 * view.projection.scale], abs=0.02)


def test_nearer_vehicles_hide_farther_ones_but_never_the_leader():
    view = make_view(3, edges=False)
    away = view.camera.basis[2]  # towards the eye
    places = UP + np.outer([-3.0, 0.0, 2.0], away)
    view.update(Frame(0.0, places))
    # One line of sight passes through all three only without parallax: in the middle of the picture.
    spots = view.projection.pixels(places)
    assert np.ptp(spots, axis=0).max() < 15.0
    assert nearest_vehicle(at(view.draw(), spots[0]), view.colours) == 0
    view.update(Frame(1.0, places * [[np.nan], [1.0], [1.0]]))
    spot = view.projection.pixels(places[2])
    assert nearest_vehicle(at(view.draw(), spot), view.colours) == 2


def test_edges_trails_and_slots_are_drawn_only_on_request():
    view = make_view(3, trails=10.0)
    places = np.array([[0.0, 0.0, 20.0], [6.0, 0.0, 20.0], [0.0, 6.0, 22.0]])
    for k in range(20):
        way = np.array([[0, 0, 0], [0.2 * (k - 19), 0, 0], [0, 0, 0]])  # the second comes from the west
        view.update(Frame(0.5 * k, places + way, places, np.array([[2, 0]])))
    projection = view.projection
    link = projection.pixels(0.5 * (places[0] + places[2]))
    trail = projection.pixels(places[1] - [1.7, 0.0, 0.0])
    slot, near = projection.pixels_and_nearness(places[2])
    ring = slot + np.array([0.0, 1.75 * view._scene.radius * near * view.pixel])
    picture = view.draw().copy()

    def changed(place: np.ndarray) -> bool:
        rows, column = view.size[1] - int(place[1]), int(place[0])
        part = np.s_[rows - 2 : rows + 2, column - 2 : column + 2]
        return bool((view.draw()[part] != picture[part]).any())

    assert not any(map(changed, (link, trail, ring)))
    view.show_edges = False
    assert [changed(p) for p in (link, trail, ring)] == [True, False, False]
    view.show_edges, view.trails = True, 0.0
    assert [changed(p) for p in (link, trail, ring)] == [False, True, False]
    view.trails, view.show_slots = 10.0, False
    assert [changed(p) for p in (link, trail, ring)] == [False, False, True]
    for place, colour in ((trail, view.colours[1]), (ring, view.colours[2])):
        part = picture[view.size[1] - int(place[1]) - 2 :, int(place[0]) - 2 :][:4, :4, :3].reshape(-1, 3) / 255.0
        darkest = part[part.sum(axis=1).argmin()]
        assert nearest_vehicle(darkest, view.colours) == np.abs(view.colours - colour).sum(axis=1).argmin()


def test_trails_last_as_long_as_they_shall_and_end_with_a_reset():
    view = make_view(9, trails=0.5)
    frames = list(flight(number=30))
    for frame in frames:
        view.update(frame)
    ages, points = view.trail_points()
    assert ages[0] == pytest.approx(0.5)
    assert ages[-1] == 0.0
    assert (np.diff(ages) < 0.0).all()
    assert (points[0] == frames[-6].positions).all()
    view.update(frames[0])  # time goes back
    assert len(view.trail_points()[0]) == 1


def test_a_long_trail_of_a_fast_film_has_few_points():
    view = make_view(9, trails=4.0)
    for k in range(2000):
        view.update(Frame(k / 250.0, np.zeros((9, 3)) + k / 250.0))
    assert 45 <= len(view.trail_points()[0]) <= 52


def test_cached_parts_of_a_picture_equal_a_new_drawing():
    """With the room cached while the camera rests, the pixels equal those of a complete drawing by savefig."""
    view = make_view(30)
    for frame in flight(30, 8):
        view.update(frame)
        view.draw()
    fast = view.draw().copy()
    view.canvas.draw()
    assert (np.asarray(view.canvas.buffer_rgba()) == fast).all()


def test_an_unknown_vehicle_is_skipped():
    view = make_view(9)
    frame = formation(9)
    view.update(frame)
    spot = view.projection.pixels(frame.positions[4])
    positions = frame.positions.copy()
    positions[4] = np.nan
    view.update(Frame(0.1, positions, frame.slots, frame.edges))
    assert nearest_vehicle(at(view.draw(), spot), view.colours) != 4
    view.update(Frame(0.2, np.full((9, 3), np.nan)))
    assert view.draw().shape == (HEIGHT, 800, 4)


def test_a_thousand_vehicles_are_all_in_the_picture():
    view = make_view(1000, edges=False, slots=False)
    frame = formation(1000)
    view.update(frame)
    places = view.projection.pixels(frame.positions)
    assert (places > 0.0).all()
    assert (places < [800.0, HEIGHT]).all()
    picture = view.draw()
    coloured = sum(np.ptp(at(picture, p)) > 0.15 for p in places[1:])
    assert coloured > 900  # the others are behind a neighbour's white rim
    assert len(np.unique(palette(1000), axis=0)) == 25


def test_names_are_shown_for_few_vehicles_only():
    assert len(make_view(18)._scene._names) == 18
    assert len(make_view(19)._scene._names) == 0


# ---- the box ----


def test_the_box_holds_all_vehicles_follows_smoothly_and_rests():
    box = FollowingBox()
    points = np.array([[0.0, 0, 30], [10, 10, 40]])
    before = box.follow(0.0, points)
    moved = [box.follow(0.04 * k, points + 0.02 * k * EAST) for k in range(1, 500)]
    for k, now in enumerate(moved, 1):
        assert (now.low <= points.min(axis=0) + 0.02 * k * EAST).all()
        assert (now.high >= points.max(axis=0) + 0.02 * k * EAST).all()
        assert np.abs(now.low - before.low).max() < 0.1
        before = now
    rest = [box.follow(20.0 + 0.04 * k, points + 10.0 * EAST) for k in range(200)]
    assert np.abs(rest[-1].low - rest[-2].low).max() < 1e-3
    again = box.follow(1.0, points)  # time went back
    assert (again.low == FollowingBox().follow(0.0, points).low).all()


@pytest.mark.parametrize("height", [0.0, 3.0, 200.0])
def test_the_ground_is_the_floor_where_it_is_near(height):
    points = np.array([[0.0, 0, height], [10, 10, height + 2.0]])
    low = FollowingBox().follow(0.0, points).low[2]
    assert (low == 0.0) == (height < 100.0)


@pytest.mark.parametrize(("size", "step"), [(7.0, 1.0), (14.0, 2.0), (30.0, 5.0), (100.0, 10.0), (130.0, 20.0)])
def test_the_grid_has_round_steps(size, step):
    points = np.array([[0.0, 0, 500.0], [size / 1.3, 0, 500.0]])
    assert grid_step(FollowingBox().follow(0.0, points)) == step


# ---- films ----


def probe(path: Path) -> dict:
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(path)]
    return json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)["streams"][0]


def test_a_film_has_every_frame_and_plays_in_browsers(tmp_path):
    path = film(flight(number=12), tmp_path / "swarm.mp4", fps=12.5, progress=False, size=(321, 241))
    stream = probe(path)
    assert stream["nb_read_frames"] == "12"
    assert (stream["codec_name"], stream["pix_fmt"], stream["r_frame_rate"]) == ("h264", "yuv420p", "25/2")
    assert (stream["width"], stream["height"]) == (322, 242)  # even, as yuv420p needs
    assert os.listdir(tmp_path) == ["swarm.mp4"]
    assert path.stat().st_mode & 0o777 == 0o666 & ~_mask()


def _mask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_film_shows_the_vehicles(tmp_path):
    frames = list(flight(number=5))
    view = make_view()
    path = film(frames, tmp_path / "swarm.mp4", progress=False, view=view)
    command = ["ffmpeg", "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgba", "pipe:1"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    pictures = np.frombuffer(raw, np.uint8).reshape(-1, HEIGHT, 800, 4)
    assert len(pictures) == 5
    assert np.abs(pictures[-1].astype(int) - view.draw()).mean() < 2.0
    assert nearest_vehicle(at(pictures[-1], view.projection.pixels(frames[-1].positions[1])), view.colours) == 1


def test_a_gif_has_every_frame_at_its_time(tmp_path):
    frames = list(flight(number=10, fps=15.0))
    view = make_view()
    path = film(frames, tmp_path / "swarm.GIF", fps=15.0, progress=False, view=view)
    with Image.open(path) as image:
        assert image.n_frames == 10
        assert image.info["loop"] == 0
        spans = []
        for k in range(10):
            image.seek(k)
            spans.append(image.info["duration"])
        last = np.array(image.convert("RGB")).astype(int)
    assert set(spans) == {60, 70}
    assert sum(spans) == 670
    assert np.abs(last - view.draw()[..., :3]).mean() < 2.0
    assert (last[5, 5] == 255).all()


def test_a_png_is_the_last_frame_with_its_trails(tmp_path):
    view = make_view()
    path = film(flight(), tmp_path / "swarm.png", progress=False, view=view)
    with Image.open(path) as image:
        assert (np.array(image) == view.draw()[..., :3]).all()
    assert len(view.trail_points()[0]) == 20


def test_the_same_frames_make_the_same_pictures():
    first, second = make_view(), make_view()
    for frame in flight():
        first.update(frame)
        second.update(frame)
        first.draw()
    assert (first.draw() == second.draw()).all()


def interrupted(error: type[BaseException]) -> Iterator[Frame]:
    yield from flight(number=6)
    raise error("enough")


@pytest.mark.parametrize("kind", [".mp4", ".gif", ".png"])
def test_a_failed_film_leaves_the_previous_one(tmp_path, kind):
    path = tmp_path / f"swarm{kind}"
    path.write_text("an older film")
    with pytest.raises(RuntimeError, match="enough"):
        film(interrupted(RuntimeError), path, progress=False, size=(320, 240))
    assert path.read_text() == "an older film"
    assert os.listdir(tmp_path) == [path.name]


def test_a_film_that_is_broken_off_can_be_read(tmp_path):
    for kind in (".mp4", ".gif"):
        path = tmp_path / f"swarm{kind}"
        with pytest.raises(KeyboardInterrupt):
            film(interrupted(KeyboardInterrupt), path, progress=False, size=(320, 240))
        assert probe(path)["nb_read_frames"] == "6"
    assert sorted(os.listdir(tmp_path)) == ["swarm.gif", "swarm.mp4"]


def test_progress_is_shown(tmp_path):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120)
    film(flight(number=7), tmp_path / "a.gif", progress=console, total=7, size=(320, 240))
    assert "film a.gif" in out.getvalue()
    assert "7/7" in out.getvalue()


# ---- a swarm's flight ----


def fly_cube(swarm: Swarm) -> None:
    """Select the cube at 0.5 s."""
    if not swarm.leader.pattern and swarm.time > 0.5:
        swarm.choose("cube")


def test_a_swarm_is_filmed_while_it_flies_and_afterwards(tmp_path):
    swarm = Swarm(6)
    live = swarm.film(tmp_path / "live.mp4", seconds=2.0, fps=10.0, each_turn=fly_cube, progress=False, size=(320, 240))
    assert swarm.time == pytest.approx(2.0, abs=0.034)
    assert probe(live)["nb_read_frames"] == "21"
    later = swarm.film(tmp_path / "later.mp4", start=0.5, end=1.5, fps=10.0, speed=0.5, progress=False, size=(320, 240))
    assert probe(later)["nb_read_frames"] == "21"
    assert swarm.time == pytest.approx(2.0, abs=0.034)


def test_frames_of_a_flight_show_the_flight():
    swarm, other = Swarm(6), Swarm(6)
    live = list(_flying(swarm, 2.0, 0.1, "", fly_cube))
    recorded = list(_replay(swarm, 0.1 * np.arange(1, 21), ""))
    for a, b in zip(live[1:], recorded, strict=True):
        assert a.positions == pytest.approx(b.positions, abs=1e-9)
        assert a.time == pytest.approx(b.time)
    assert live[3].slots is None
    assert live[-1].title == recorded[-1].title == "cube"
    offsets = swarm.leader.offsets
    assert live[-1].slots == pytest.approx(live[-1].positions[0] + np.vstack([np.zeros(3), offsets]))
    assert {tuple(e) for e in live[-1].edges} == {tuple(e) for e in np.argwhere(swarm.leader.adjacency > 0)}
    while other.time < swarm.time:  # filming changes nothing
        fly_cube(other)
        other.step()
    assert (other.true_positions == swarm.true_positions).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "nothing has been flown yet"),
        ({"seconds": 0.0}, "0.0 seconds are not allowed"),
        ({"seconds": 1.0, "speed": 0.0}, "speed 0.0 is not allowed"),
        ({"seconds": 1.0, "fps": 0.0}, "0.0 frames per second are not allowed"),
    ],
)
def test_a_flight_that_cannot_be_filmed_is_reported(tmp_path, options, words):
    with pytest.raises(FilmError, match=words):
        Swarm(3).film(tmp_path / "a.mp4", progress=False, **options)
    assert os.listdir(tmp_path) == []


def test_a_part_that_was_not_flown_is_not_filmed(tmp_path):
    swarm = Swarm(3)
    swarm.run(0.5)
    with pytest.raises(FilmError, match=r"0.1 s to 7.0 s; recorded are 0.036 s to 0.\d+ s"):
        swarm.film(tmp_path / "a.mp4", start=0.1, end=7.0)
    with pytest.raises(FilmError, match="keeps no record"):
        Swarm(3, record=False).film(tmp_path / "a.mp4")


# ---- the window ----


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """An X server without a screen."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x800x24", "-nolisten", "tcp", "-noreset"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()
    assert number, "Xvfb did not start"
    yield f":{number}"
    server.terminate()
    server.wait()


@pytest.fixture
def window(display, monkeypatch) -> Iterator[Window]:
    monkeypatch.setenv("DISPLAY", display)
    window = Window(make_view(9, size=(400, 300)))
    window.view.update(formation(9))
    yield window
    window.close()


def play(window: Window, *actions) -> None:
    """Run the window, one action between two pictures once it is on the screen, then close it."""
    window._root.update()
    left = iter(actions)

    def source() -> Frame | None:
        action = next(left, window.close)
        return action()

    window.run(source)


def event(window: Window, name: str, **options):
    """Return an action: a mouse or keyboard event."""

    def generate() -> None:
        widget = window._canvas.get_tk_widget()
        if name.startswith("<Key"):
            widget.focus_force()
            widget.update()
        widget.event_generate(name, **options)

    return generate


def test_scrolling_zooms_about_the_middle_and_r_resets(window):
    zooms, middles = [], []

    def note() -> None:
        zooms.append(window.view.camera.zoom)
        middles.append(window.view.projection.pixels(window.view.box.middle))

    def corner() -> None:
        corners.append(window.view.projection.pixels(window.view.box.corners))

    corners: list[np.ndarray] = []
    up, down = (event(window, f"<Button-{n}>", x=20, y=30) for n in (4, 5))
    play(window, note, corner, up, up, note, corner, down, note, event(window, "<KeyPress>", keysym="r"), note)
    assert zooms == pytest.approx([1.0, 1.15**2, 1.15, 1.0])
    centres = [0.5 * (c.min(axis=0) + c.max(axis=0)) for c in corners]
    assert centres[0] == pytest.approx(centres[1])
    assert np.ptp(corners[1], axis=0) == pytest.approx(1.15**2 * np.ptp(corners[0], axis=0))


def test_dragging_turns(window):
    before = (window.view.camera.azimuth, window.view.camera.elevation)
    drag = [
        event(window, "<Button-1>", x=100, y=100),
        event(window, "<Motion>", x=200, y=130, state=0x100),
        event(window, "<ButtonRelease-1>", x=200, y=130),
        event(window, "<Motion>", x=300, y=250),
    ]
    play(window, *drag)
    assert window.view.camera.azimuth == pytest.approx(before[0] - 180.0 * 100 / 400)
    assert window.view.camera.elevation == pytest.approx(before[1] + 180.0 * 30 / 300)


def test_keys_toggle_the_drawn_elements(window):
    view, seen = window.view, []

    def note() -> None:
        seen.append((window.paused, view.trails > 0.0, view.show_edges, view.show_slots, bool(view.help)))

    actions = [note]
    for key in ("space", "t", "e", "s", "h", "x"):
        actions += [event(window, "<KeyPress>", keysym=key), note]
    play(window, *actions, *actions[1:])
    full = (False, True, True, True, False)
    none = (True, False, False, False, True)
    assert seen == [full] + [none[:k] + full[k:] for k in (1, 2, 3, 4, 5, 5)] + [full[:k] + none[k:] for k in
                                                                                (1, 2, 3, 4, 5, 5)]  # fmt: skip
    for key in ("q", "Escape"):
        other = Window(make_view(9))
        play(other, event(other, "<KeyPress>", keysym=key), *[lambda: None] * 200)
        assert not other.open


def test_the_window_shows_the_picture_and_follows_its_size(window):
    shots = []

    def shot() -> None:
        window.redraw()
        shots.append(np.asarray(window._canvas.buffer_rgba()).copy())

    def resize() -> None:
        window._root.geometry("640x480")
        window._root.update()

    play(window, shot, resize, shot)
    assert [s.shape for s in shots] == [(300, 400, 4), (480, 640, 4)]
    for picture in shots:
        twin = make_view(9, size=(picture.shape[1], picture.shape[0]))
        twin.hint = window.view.hint
        twin.update(formation(9))
        assert (twin.draw() == picture).all()


def test_a_picture_is_drawn_only_when_something_has_changed(window):
    frames = list(flight(number=5))
    play(window, *[lambda f=f: f for f in frames], *[lambda: None] * 10)
    assert 5 <= window.pictures <= 7  # one more picture for the window's actual size


def test_nothing_of_tk_outlives_the_window(window):
    root, canvas, image = map(weakref.ref, (window._root, window._canvas, window._canvas._tkphoto))
    play(window, window.redraw)
    assert (root(), canvas(), image()) == (None, None, None)
    assert window.view.draw().any()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_errors_of_the_simulation_close_the_window_and_propagate(window, error):
    def fail() -> None:
        raise error("enough")

    with pytest.raises(error, match="enough"):
        play(window, fail)
    assert not window.open


def test_a_swarm_is_shown_at_the_requested_speed(display, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    swarm, turns = Swarm(4), []

    def each_turn(it: Swarm) -> None:
        turns.append(it.time)
        if it.time > 3.0:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        swarm.watch(speed=float("inf"), each_turn=each_turn, size=(320, 240))
    assert np.diff(turns) == pytest.approx(1.0 / 30.0, abs=0.005)  # no turn is skipped


def test_a_paused_swarm_does_not_move(window, monkeypatch):
    monkeypatch.setattr(flight_module, "_BUDGET", 0.0)  # one turn a picture
    swarm = Swarm(9)
    player = _Player(swarm, window, lambda: not swarm.step(), float("inf"), 1.0)
    player()
    now = player()
    assert now is not None
    assert 0.0 < now.time == swarm.time < 0.2
    window.paused = True
    assert player() is None
    assert swarm.time == now.time
    window.paused = False
    while swarm.time < 1.0:
        player()
    assert player() is None  # the end
    assert swarm.time == pytest.approx(1.0, abs=0.034)


def test_a_flight_that_ends_closes_the_window(window):
    swarm = Swarm(9)
    turns = iter([True] * 30)

    def turn() -> bool:
        swarm.step()
        return next(turns, False)

    window.run(_Player(swarm, window, turn, float("inf"), float("inf")))
    assert not window.open
    assert swarm.time == pytest.approx(31 / 30.0, abs=0.005)


def test_whether_a_window_can_be_opened(window, monkeypatch):
    assert can_open()
    monkeypatch.setenv("DISPLAY", f"unix{os.environ['DISPLAY']}.0")
    assert can_open()
    for nobody in (":987", "127.0.0.1:987", "nonsense", "host:"):
        monkeypatch.setenv("DISPLAY", nobody)
        assert not can_open()
    monkeypatch.delenv("DISPLAY")
    assert not can_open()


def test_without_a_display_the_message_has_the_remedy(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(WindowError, match=r"DISPLAY is not set.*a film needs none.*Swarm.film"):
        Swarm(3).watch()
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(WindowError, match=r"cannot be opened.*:987.*a film needs none"):
        Window(make_view(3))


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"speed": float("nan")}, {"seconds": -1.0}])
def test_watching_at_no_speed_is_rejected(options):
    with pytest.raises(ValueError, match="not allowed"):
        Swarm(3).watch(**options)


def test_matplotlib_is_loaded_only_for_pictures():
    code = "import sys; from xtdrone_swarm import Swarm; Swarm(3).run(1.0); print('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout == "False\n"


# ---- bad input ----


@pytest.mark.parametrize(
    ("name", "fps", "words"),
    [
        ("swarm.avi", 25.0, "unknown ending '.avi'; allowed are .mp4, .gif and .png"),
        ("swarm", 25.0, "unknown ending ''"),
        ("swarm.mp4", 0.0, "0.0 frames per second are not allowed, 0.1 to 120"),
        ("swarm.mp4", float("nan"), "nan frames per second"),
        ("swarm.gif", 60.0, "60.0 frames per second are not allowed, 0.1 to 50"),
        ("nowhere/swarm.mp4", 25.0, "nowhere does not exist"),
        ("folder.mp4", 25.0, "is a folder"),
    ],
)
def test_a_film_that_cannot_be_written_is_rejected_before_it_is_drawn(tmp_path, name, fps, words):
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(FilmError, match=words):
        film(interrupted(AssertionError), tmp_path / name, fps=fps, progress=False)


def test_an_unwritable_folder_is_reported():
    with pytest.raises(FilmError, match=r"film /proc/swarm.png: .*(writable|cannot be written)"):
        film(flight(), "/proc/swarm.png", progress=False)


def test_a_film_without_ffmpeg_names_the_package(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FilmError, match=r"ffmpeg is missing \(package ffmpeg\)"):
        check_film(tmp_path / "swarm.mp4")
    assert check_film(tmp_path / "swarm.gif") == tmp_path / "swarm.gif"


def test_an_ffmpeg_that_dies_is_quoted(tmp_path, monkeypatch):
    fake = tmp_path / "bin" / "ffmpeg"
    fake.parent.mkdir()
    fake.write_text("#!/bin/sh\necho 'Unknown encoder libx264' >&2\nexit 1\n")
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{fake.parent}:/bin")
    with pytest.raises(FilmError, match="Unknown encoder libx264"):
        film(flight(), tmp_path / "swarm.mp4", progress=False)
    assert os.listdir(tmp_path) == ["bin"]


def test_a_film_without_frames_is_rejected(tmp_path):
    for kind in ("gif", "mp4", "png"):
        with pytest.raises(FilmError, match="no frame"):
            film([], tmp_path / f"a.{kind}", progress=False)
    with pytest.raises(FilmError, match="no frame"), FilmWriter(tmp_path / "a.mp4", (320, 240)):
        pass
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (Frame(0.0, np.zeros((8, 3))), r"positions have shape \(8, 3\), 9 vehicles need \(9, 3\)"),
        (Frame(0.0, np.zeros((9, 3)), np.zeros((8, 3))), r"slots have shape \(8, 3\)"),
        (Frame(0.0, np.zeros((9, 3)), None, np.array([[0, 9]])), "edges name vehicles 0 to 9, there are 0 to 8"),
        (Frame(float("nan"), np.zeros((9, 3))), "time nan"),
    ],
)
def test_a_frame_of_the_wrong_size_is_rejected(frame, words):
    with pytest.raises(ValueError, match=words):
        make_view(9).update(frame)


@pytest.mark.parametrize(
    ("count", "options", "words"),
    [
        (0, {}, "no vehicle"),
        (9, {"trails": -1.0}, "trails of -1.0 s"),
        (9, {"trails": float("nan")}, "trails of nan s"),
        (9, {"size": (100, 480)}, r"size \(100, 480\) is not allowed, 200 to 4096"),
    ],
)
def test_an_invalid_view_is_rejected(count, options, words):
    with pytest.raises(ValueError, match=words):
        make_view(count, **options)
