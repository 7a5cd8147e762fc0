"""The station's handling of the simulator's messages and of pages' requests."""

from __future__ import annotations

import asyncio
import io
import json
import struct
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rospy")

from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3
from mavros_msgs.msg import Waypoint, WaypointList
from xtdrone_msgs.msg import SimulationStatus

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.settings import SettingError
from xtdrone_interaction.doctor.findings import Graph, Vehicle
from xtdrone_interaction.doctor.graph import Master
from xtdrone_interaction.simulation_services import SimError
from xtdrone_interaction.web.commands.swarm_commands import checked_slots
from xtdrone_interaction.web.commands.vehicle_commands import VehicleCommand, chosen_vehicles, goals_of
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet import fleet_watch, vehicle_status
from xtdrone_interaction.web.fleet.fleet_frame import CHANNEL, pack_fleet_frame
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.fleet.model_states_bytes import COLUMNS, TruncatedError, read_model_states
from xtdrone_interaction.web.fleet.roster import Roster
from xtdrone_interaction.web.fleet.shapes_for_page import ShapeStore, describe_vehicle
from xtdrone_interaction.web.fleet.vehicle_status import VehicleStatus
from xtdrone_interaction.web.map import search_view
from xtdrone_interaction.web.map.search_view import SearchView, way_of
from xtdrone_interaction.web.server.methods import CallError
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

FLEET = parse_fleet("iris:2")


def packed(places: dict[str, tuple[float, float, float]]) -> bytes:
    """Return the bytes of a ModelStates; each model turned by its number, moving at its place's value."""
    message = ModelStates()
    for number, (name, (x, y, z)) in enumerate(places.items()):
        message.name.append(name)
        message.pose.append(Pose(Point(x, y, z), Quaternion(0.1, 0.2, 0.3, float(number))))
        message.twist.append(Twist(Vector3(-x, -y, -z), Vector3()))
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


numbers = st.floats(-1e6, 1e6)


@given(st.dictionaries(st.text(max_size=12), st.tuples(numbers, numbers, numbers), max_size=6), st.floats(0.0, 0.999))
@settings(max_examples=40)
def test_bytes_are_read_as_the_message_s_class_reads_them(
    places: dict[str, tuple[float, float, float]], share: float
) -> None:
    data = packed(places)
    models = read_model_states(data)
    assert list(models.names) == list(places)
    for number, (row, (x, y, z)) in enumerate(zip(models.rows, places.values(), strict=True)):
        assert row.tolist() == [x, y, z, float(number), 0.1, 0.2, 0.3, -x, -y, -z]
    again = read_model_states(data, models)
    assert again.names is models.names
    with pytest.raises(TruncatedError, match="not allowed"):
        read_model_states(data[: int(share * len(data))])


def test_an_impossible_count_is_refused() -> None:
    with pytest.raises(TruncatedError, match="4294967295 models are not allowed"):
        read_model_states(struct.pack("<I", 0xFFFFFFFF) + bytes(50))


def test_the_frame_s_layout() -> None:
    rows = np.arange(3 * COLUMNS, dtype=float).reshape(3, COLUMNS)
    frame = bytes([CHANNEL]) + pack_fleet_frame(rows[:2], rows[2:], 12.5, 7, 9)
    assert struct.unpack_from("<BBHHHdII", frame) == (1, 1, 2, 1, 0, 12.5, 7, 9)
    assert np.frombuffer(frame, "<f4", offset=24).reshape(3, COLUMNS).tolist() == rows.tolist()


def test_the_roster_knows_vehicles_movers_and_what_stands() -> None:
    roster = Roster()
    roster.set_fleet(FLEET)
    places = {
        "ground_plane": (0.0, 0.0, 0.0),
        "tree": (5.0, 5.0, 0.0),
        "iris_1": (1.0, 0.0, 0.0),
        "walker": (2.0, 2.0, 0.0),
    }
    models = read_model_states(packed(places))
    vehicles, movers = roster.split(models)
    assert np.isnan(vehicles[0]).all()  # iris_0 is absent
    assert vehicles[1, :3].tolist() == [1.0, 0.0, 0.0]
    assert len(movers) == 0
    before = roster.version
    models = read_model_states(packed({**places, "walker": (2.5, 2.0, 0.0)}), models)
    assert roster.split(models)[1][:, :3].tolist() == [[2.5, 2.0, 0.0]]
    assert roster.version > before
    described = roster.describe(models)
    assert described["movers"] == ["walker"]
    assert set(described["places"]) == {"tree", "walker"}
    assert [vehicle["name"] for vehicle in described["vehicles"]] == ["iris_0", "iris_1"]
    models = read_model_states(packed({"iris_0": (0.0, 0.0, 0.0)}), models)  # all others are gone
    vehicles, movers = roster.split(models)
    assert np.isnan(vehicles[1]).all()
    assert len(movers) == 0


# ---- a page's requests to the flight


class Topics:
    """rospy's subscriptions: the topics subscribed to, of which those with a publisher are connected."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *modules: Any) -> None:
        self.open: list[str] = []
        self.published: set[str] = set()
        rospy = SimpleNamespace(Subscriber=self._subscribe, AnyMsg=None, get_param=lambda *_: "iris:2")
        for module in modules:
            monkeypatch.setattr(module, "rospy", rospy)

    def _subscribe(self, topic: str, *_: Any, **__: Any) -> Any:
        self.open.append(topic)
        return SimpleNamespace(
            unregister=lambda: self.open.remove(topic), get_num_connections=lambda: int(topic in self.published)
        )


class Page:
    """A page that keeps the messages sent to it."""

    number = 1

    def __init__(self) -> None:
        self.told: list[Any] = []

    def push_text(self, text: str) -> None:
        self.told.append(json.loads(text))


def of(context: StationContext, page: Page) -> None:
    context.sessions[page.number] = page  # type: ignore[assignment]


def test_vehicles_of_the_mavros_layer_are_asked_together_and_others_are_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    asked_nodes: list[Sequence[str]] = []
    answers = {
        "iris_0": Vehicle(name="iris_0", prefix="/iris_0/mavros", served=True, heard=True, connected=True, armed=True,
                          mode="OFFBOARD", battery=0.5, estimates=("attitude", "height"), checks=()),
    }  # fmt: skip

    def read_master(uri: str, alive: Sequence[str]) -> Master:
        asked_nodes.append(alive)
        return Master(uri, Graph())

    def read_asked(_master: Master, *, telemetry: bool) -> list[Vehicle]:
        if not answers:
            raise SimError("MAVROS does not answer")
        return list(answers.values()) if telemetry else []

    async def test() -> None:
        topics, page = Topics(monkeypatch, vehicle_status), Page()
        topics.published.add("/simulator/status")
        monkeypatch.setattr(vehicle_status, "read_master", read_master)
        monkeypatch.setattr(vehicle_status, "read_asked_vehicles", read_asked)
        context = StationContext("http://127.0.0.1:9", "/web_station")
        status = VehicleStatus(context, SimpleNamespace(names=["iris_0", "real_0"]))  # type: ignore[arg-type]
        status._on_simulation(SimulationStatus(participants=["/mavros", "/iris_0_communication"]))
        await status._send()
        assert topics.open == ["/simulator/status"]  # without pages no request is sent
        assert asked_nodes == []
        of(context, page)
        await status._send()
        own = [f"/real_0/mavros/{name}" for name in ("battery", "estimator_status", "state")]
        assert topics.open == ["/simulator/status", *own]
        assert asked_nodes == [("/iris_0_communication", "/mavros")]  # participants are known to be alive
        vehicle = page.told[0]["data"]["vehicles"]["iris_0"]
        assert (vehicle["mode"], vehicle["battery"]) == ("OFFBOARD", 0.5)
        assert vehicle["estimator"] == ["velocity", "position"]
        answers.clear()
        status._due = 0.0
        await status._send()
        assert page.told[1]["data"]["trouble"] == "MAVROS does not answer"
        assert page.told[1]["data"]["vehicles"]["iris_0"]["battery"] == 0.5  # the last reply
        assert len(asked_nodes) == 1  # the graph is read less often
        context.sessions.clear()
        await status._send()
        assert topics.open == ["/simulator/status"]
        context.close()

    asyncio.run(test())


def test_states_come_from_the_topic_by_the_wall_clock_where_it_is_published(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        topics = Topics(monkeypatch, fleet_watch)
        now = [0.0]
        monkeypatch.setattr(fleet_watch, "time", SimpleNamespace(monotonic=lambda: now[0]))
        context = StationContext("http://127.0.0.1:9", "/web_station")
        watch = FleetWatch(context, 10.0)
        watch._send()
        assert topics.open == []
        of(context, Page())
        watch._send()
        assert topics.open == ["/xtdrone/live_states"]
        now[0] = 2.0
        await watch._read_fleet()  # no simulator of the project
        assert sorted(topics.open) == ["/gazebo/model_states", "/xtdrone/live_states"]
        topics.published.add("/xtdrone/live_states")
        await watch._read_fleet()
        assert topics.open == ["/xtdrone/live_states"]
        context.sessions.clear()
        watch._send()
        assert topics.open == []
        context.close()

    asyncio.run(test())


def test_missions_are_subscribed_to_for_pages_with_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        topics, page = Topics(monkeypatch, search_view), Page()
        context = StationContext("http://127.0.0.1:9", "/web_station")
        of(context, page)
        view = SearchView(context, SimpleNamespace(names=["iris_0"]), lambda: None)  # type: ignore[arg-type]
        before = list(topics.open)
        await view._follow_fleet()
        assert topics.open == before
        assert await view._missions(page, {}) == {}  # type: ignore[arg-type]
        await view._follow_fleet()
        assert topics.open == [*before, "/iris_0/mavros/mission/waypoints"]
        context.sessions.clear()
        await view._follow_fleet()
        assert topics.open == before
        context.close()

    asyncio.run(test())


def test_a_group_keeps_its_shape() -> None:
    goals = goals_of((10.0, 20.0, 5.0), {"a": (0.0, 0.0, 1.0), "b": (2.0, 4.0, 3.0)})
    assert goals == {"a": (9.0, 18.0, 4.0), "b": (11.0, 22.0, 6.0)}
    assert goals_of((1.0, 2.0, 3.0), {"a": None}) == {"a": (1.0, 2.0, 3.0)}
    with pytest.raises(CallError, match="the position of b is unknown"):
        goals_of((0.0, 0.0, 5.0), {"a": (0.0, 0.0, 1.0), "b": None})


@pytest.mark.parametrize("names", [None, [], "iris_0", ["iris_7"], [3], [["iris_0"]]])
def test_wrong_vehicles_are_refused(names: Any) -> None:
    with pytest.raises(CallError, match="vehicles: "):
        chosen_vehicles(names, FLEET)


@pytest.mark.parametrize(
    "given",
    [
        {"action": "explode"},
        {"action": "goto"},
        {"action": "goto", "place": [1, 2]},
        {"action": "goto", "place": [float("nan"), 0, 0]},
        {"action": "takeoff", "height": 1e9},
        {"action": "takeoff", "height": True},
        {"action": "mode"},
        {"action": "arm", "force": True},
    ],
)
def test_wrong_commands_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(SettingError, match="not allowed"):
        VehicleCommand.from_mapping(given, "command")


@pytest.mark.parametrize(
    "slots", [None, [], [[1, 2, 3]], [[1, 2], [3, 4]], [[1, 2, 3], [1, 2, 3.1]], [[0, 0, 0.1], [5, 5, 5]],
              [[float("nan"), 0, 0], [1, 1, 1]], [["a", 0, 0], [1, 1, 1]], [[1e9, 0, 0], [1, 1, 1]]]
)  # fmt: skip
def test_wrong_drawn_patterns_are_refused(slots: Any) -> None:
    with pytest.raises(CallError, match="slots: "):
        checked_slots(slots, 2)


def test_a_mission_s_way() -> None:
    datum = Datum(47.4, 8.5, 480.0)
    latitude, longitude = datum.place(30.0, -20.0)
    waypoints = [
        Waypoint(command=22, x_lat=latitude, y_long=longitude, z_alt=10.0),
        Waypoint(command=178, param2=5.0),  # a speed has no position
        Waypoint(command=16, x_lat=0.0, y_long=0.0),
        Waypoint(command=20),
    ]
    (place,) = way_of(WaypointList(waypoints=waypoints), datum)
    assert place == pytest.approx([30.0, -20.0, 10.0], abs=1e-3)


@pytest.mark.parametrize("name", ["iris", "typhoon_h480", "solo"])
def test_vehicles_are_described_with_all_rotors(name: str) -> None:
    model, store = load_vehicle(name), ShapeStore()
    described = describe_vehicle(model, store)
    assert len(described["rotors"]) == int(model.record["rotor_count"])
    assert {rotor["direction"] for rotor in described["rotors"]} == {1.0, -1.0}
    assert all(len(shape["pose"]) == 7 and len(shape["size"]) == 3 for shape in described["body"])
    for wrong in (None, -1, 99, "0", 0.0):
        with pytest.raises(CallError, match="mesh: "):
            store.mesh(wrong)  # type: ignore[arg-type]
