"""The station's recordings, keyboard and gamepad, without a ROS master and a browser."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.keyboard.key_bindings import Message, Pilot, Setpoint, Target
from xtdrone_interaction.recording.open_recording import open_recording
from xtdrone_interaction.recording.recorded_flight import Recording, VehicleRecord
from xtdrone_interaction.recording.series_in_bounded_memory import Series
from xtdrone_interaction.web.recordings.playable_flight import playable
from xtdrone_interaction.web.recordings.recorder_process import RecorderProcess
from xtdrone_interaction.web.recordings.recording_room import allowed_file, listed
from xtdrone_interaction.web.recordings.results import read_results
from xtdrone_interaction.web.server.methods import CallError
from xtdrone_interaction.web.steering import steering_room
from xtdrone_interaction.web.steering.page_pilot import SILENCE, PagePilot
from xtdrone_interaction.web.steering.steering_room import SteeringRoom

# ---- recordings


def recorded(*vehicles: VehicleRecord) -> Recording:
    return Recording(Path("made.bag"), 0, vehicles=list(vehicles))


def test_a_flight_is_played_at_its_recorded_poses_and_velocities() -> None:
    time = np.linspace(5.0, 9.0, 41)
    pose = np.stack([time, 2.0 * time, 0.0 * time, *np.tile([0.1, 0.2, 0.3, 0.9], (41, 1)).T], axis=1)
    late = np.array([[7.0], [8.0]])
    flight = playable(
        recorded(
            VehicleRecord("iris_0", {"pose": Series(time, pose)}, modes=[(6.0, "OFFBOARD")], armed=[(5.5, True)]),
            VehicleRecord("iris_1", {"pose": Series(late[:, 0], np.hstack([late, late, late]))}),
        )
    )
    assert flight.names == ("iris_0", "iris_1")
    assert (flight.start, flight.period, flight.frames.shape) == (5.0, 0.1, (41, 2, 10))
    np.testing.assert_allclose(flight.frames[10, 0], [6, 12, 0, 0.9, 0.1, 0.2, 0.3, 1, 2, 0], atol=1e-5)
    assert np.isnan(flight.frames[10, 1, :3]).all()
    np.testing.assert_allclose(flight.frames[25, 1, :7], [7.5, 7.5, 7.5, 1, 0, 0, 0], atol=1e-5)
    assert [(event["time"], event["text"]) for event in flight.events] == [(5.5, "armed"), (6.0, "OFFBOARD")]


def test_a_bag_is_played_with_all_its_vehicles(flight_bag: Path) -> None:
    recording = open_recording([flight_bag])
    flight = playable(recording)
    assert set(flight.names) == {vehicle.name for vehicle in recording.vehicles}
    first = recording.vehicles[0]
    assert first.position is not None
    middle = flight.frames[len(flight.frames) // 2, flight.names.index(first.name), :3]
    expected = first.position.at(np.array([flight.start + flight.period * (len(flight.frames) // 2)]))[0]
    np.testing.assert_allclose(middle, expected, atol=1e-3)


def test_a_flight_without_positions_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'made.bag' has no positions of vehicles"):
        playable(recorded(VehicleRecord("iris_0")))


def test_only_recordings_below_the_folder_are_opened(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    (runs / "deep").mkdir(parents=True)
    for name in ("a.bag", "deep/b.ulg", "notes.txt"):
        (runs / name).write_text("x")
    (tmp_path / "secret.bag").write_text("x")
    (runs / "out.bag").symlink_to(tmp_path / "secret.bag")
    assert {entry["file"] for entry in listed(runs)} == {"a.bag", "deep/b.ulg"}
    assert allowed_file(runs, "deep/b.ulg") == runs / "deep" / "b.ulg"
    for name in ("../secret.bag", "out.bag", "notes.txt", "gone.bag", "/etc/passwd", "a.bag\0", "", "deep"):
        with pytest.raises(CallError, match="is not allowed, a recording below runs"):
            allowed_file(runs, name)
    assert listed(tmp_path / "gone") == []


def test_the_recorder_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    recorder = RecorderProcess(tmp_path, "http://127.0.0.1:9")
    with pytest.raises(OptionError, match=r"profile: '\.\./light' is not allowed, one of light, full, cameras"):
        recorder.start("../light")
    with pytest.raises(OptionError, match="no recording is running"):
        recorder.stop()
    assert recorder.state() == {"recording": False}


def test_results_are_those_of_analyse_else_of_the_demo_s_folder(tmp_path: Path) -> None:
    bag = tmp_path / "flight.bag"
    assert read_results(bag) is None
    (tmp_path / "report.json").write_text(
        '{"outcome": "landed", "series": [1, 2], "iris_0": {"way": 4.5, "deep": {"n": 1}}}'
    )
    (tmp_path / "way.png").write_bytes(b"x")
    found = read_results(bag)
    assert found is not None
    assert [path.name for path in found.pictures] == ["way.png"]
    assert found.figures == (("outcome", "landed"), ("iris_0.way", 4.5), ("iris_0.deep.n", 1))
    analysis = tmp_path / "flight-analysis"
    analysis.mkdir()
    (analysis / "report.json").write_text("{")
    (analysis / "out.png").symlink_to(tmp_path / "way.png")
    found = read_results(bag)
    assert found is not None
    assert (found.folder, found.pictures, found.figures) == (analysis, (), ())
    assert "report.json cannot be read" in found.trouble


# ---- keyboard and gamepad


class Flown:
    """The messages sent by a pilot."""

    def __init__(self, *, leader: bool = False) -> None:
        self.sent: list[tuple[str, Message]] = []
        self.pilot = PagePilot(("iris_0", "iris_1"), leader, {"1": "cube"}, lambda *entry: self.sent.append(entry))

    def taken(self) -> list[tuple[str, Message]]:
        sent, self.sent = self.sent, []
        return sent


def test_keys_and_cycles_publish_as_the_keyboard_program_does() -> None:
    flown, keyboard = Flown(), Pilot({"1": "cube"})
    for now, key in enumerate("tiiiwwajbsv,,"):
        flown.pilot.press(key, 0.01 * now)
        expected: list[Any] = [*keyboard.press(key), keyboard.cycle()]
        flown.pilot.cycle(0.01 * now)
        wanted = [(name, message) for message in expected if message is not None for name in ("iris_0", "iris_1")]
        assert flown.taken() == wanted


def test_a_silent_or_closed_page_stops_the_vehicles_once() -> None:
    flown = Flown(leader=True)
    flown.pilot.press("w", 0.0)
    flown.pilot.cycle(0.5 * SILENCE)
    assert [(name, message.forward) for name, message in flown.taken()] == [("leader", 0.01)]  # type: ignore[union-attr]
    flown.pilot.cycle(1.1 * SILENCE)
    flown.pilot.cycle(1.2 * SILENCE)
    assert flown.taken() == [("leader", Setpoint(Target.LEADER))]
    assert flown.pilot.state["note"] == "stopped: the page was silent for 1 s"
    flown.pilot.press("1", 2.0)
    assert [(name, message.text) for name, message in flown.taken()] == [("leader", "cube")]  # type: ignore[union-attr]
    flown.pilot.press("x", 2.0)
    flown.pilot.cycle(2.0)
    flown.taken()
    flown.pilot.end()
    flown.pilot.end()
    assert [message for _, message in flown.taken()] == [Setpoint(Target.LEADER)]


@settings(deadline=None, derandomize=True)
@given(st.lists(st.tuples(*[st.floats(-20, 20)] * 3, st.floats(-3, 3)), min_size=1, max_size=5))
def test_sticks_set_speeds_to_a_hundredth(steered: list[tuple[float, ...]]) -> None:
    flown = Flown()
    for speeds in steered:
        flown.pilot.steer(list(speeds), 0.0)
        flown.pilot.cycle(0.0)
        assert flown.pilot.state["speeds"] == pytest.approx(speeds, abs=0.00501)
    flown.pilot.steer([0, 0, 0, 0], 0.0)
    flown.pilot.cycle(0.0)
    flown.taken()
    flown.pilot.cycle(0.0)
    assert flown.taken() == []


@pytest.mark.parametrize(
    "speeds", [None, [], [1, 2, 3], [21, 0, 0, 0], [0, 0, 0, 3.1], ["1", 0, 0, 0], [float("nan")] * 4, {}]
)
def test_sticks_beyond_the_limits_are_refused(speeds: object) -> None:
    flown = Flown()
    with pytest.raises(ValueError, match=r"speeds: .* is not allowed, forward, left, up from -20 to 20 m/s"):
        flown.pilot.steer(speeds, 0.0)
    with pytest.raises(ValueError, match="key: 'q' is not allowed"):
        flown.pilot.press("q", 0.0)
    assert flown.taken() == []


class _Context:
    """A station whose room sends nothing on its own."""

    master = ""

    def every(self, *_: Any) -> None: ...

    async def blocking(self, call: Any, *arguments: Any) -> Any:
        return call(*arguments)


class _Page:
    """A page's session that keeps the messages sent to it."""

    def __init__(self) -> None:
        self.told: list[tuple[str, Any]] = []

    def push(self, event: str, data: Any) -> None:
        self.told.append((event, data))


def test_the_last_page_flies_and_the_others_stop_what_they_flew(monkeypatch: pytest.MonkeyPatch) -> None:
    room = SteeringRoom(_Context())  # type: ignore[arg-type]
    sent: list[tuple[str, tuple[float, ...]]] = []
    monkeypatch.setattr(room, "_send_waiting", lambda: None)

    def begin(vehicles: list[str]) -> Any:
        page: Any = _Page()
        room._pilots[page] = PagePilot(vehicles, False, {}, lambda name, message: sent.append((name, message)))  # type: ignore[arg-type]
        room._end_others(page)
        return page

    first, other, second = begin(["iris_0", "iris_1"]), begin(["iris_2"]), None
    room._key(first, {"key": "w"})
    room._cycle()
    second = begin(["iris_1"])
    assert first.told == [("steering.ended", {"text": "another page steers iris_1 now; this page no longer does"})]
    assert sent[-2:] == [("iris_0", Setpoint(Target.ALL)), ("iris_1", Setpoint(Target.ALL))]
    assert set(room._pilots) == {other, second}
    room._key(other, {"key": "g"})
    room._key(second, {"key": "g"})
    assert other.told == [("steering.ended", {"text": "another page steers leader now; this page no longer does"})]
    assert second.told == []


def test_what_a_killed_station_left_flying_is_stopped_unless_another_page_flies_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    room = SteeringRoom(_Context())  # type: ignore[arg-type]
    monkeypatch.setattr(room, "_send_waiting", lambda: None)
    deaf = "/xtdrone/iris_0/cmd_vel_flu"
    monkeypatch.setattr(room._topics, "connect", lambda topics, _: {topic: int(topic != deaf) for topic in topics})
    monkeypatch.setattr(steering_room, "_fleet", lambda: ["iris_0", "iris_1", "iris_2"])
    room._pilots[_Page()] = PagePilot(["iris_1"], False, {}, lambda *_: None)  # type: ignore[index]
    page: Any = _Page()

    def stop(**params: Any) -> Any:
        return asyncio.run(room._stop(page, {"mode": "accel", **params}))

    assert stop(vehicles=["iris_0", "iris_1"]) == {"stopped": ["iris_0"]}
    assert stop(vehicles=["iris_2"], leader=True) == {"stopped": ["leader"]}
    assert room._waiting[page] == [
        {"to": name, "mode": "accel", "speeds": [0.0, 0.0, 0.0, 0.0]} for name in ("iris_0", "leader")
    ]
    assert stop(vehicles=["iris_0"], mode="vel") == {"stopped": []}  # no node receives it
    with pytest.raises(CallError, match="vehicles: 'iris_3' is not allowed, one of iris_0, iris_1, iris_2"):
        stop(vehicles=["iris_3"])
