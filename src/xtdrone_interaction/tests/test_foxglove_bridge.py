"""Foxglove's bridge without a server: layouts, parameters, channels of the topics."""

from __future__ import annotations

import json
import math
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rospy")
pytest.importorskip("websockets")

from foxglove import Context, Parameter
from websockets.sync import server

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.bridges.foxglove.layouts import VIEWS, layout, to_text
from xtdrone_interaction.bridges.foxglove.parameter_values import ParameterError, RosParameters, flat, to_parameter
from xtdrone_interaction.bridges.foxglove.standing_client import PROTOCOL, StandingClient
from xtdrone_interaction.bridges.foxglove.topic_channels import TopicChannels

_LIMIT = 30.0  # s of wall time
LAYOUTS = Path(__file__).parents[1] / "config" / "foxglove"
FLEETS = {"formation": "iris:9", "search": "typhoon_h480:6"}


def _windows(tree: Any) -> list[str]:
    return [tree] if isinstance(tree, str) else [*_windows(tree["first"]), *_windows(tree["second"])]


@pytest.mark.parametrize("view", VIEWS)
def test_the_layout_files_are_those_that_the_program_writes(view: str) -> None:
    text = to_text(layout(view, parse_fleet(FLEETS[view])))
    assert (LAYOUTS / f"{view}.json").read_text() == text


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("fleet", ["iris:1", "iris:2", "iris:7", "typhoon_h480:100"])
def test_every_panel_has_its_window_once(view: str, fleet: str) -> None:
    made = layout(view, parse_fleet(fleet))
    assert sorted(_windows(made["layout"])) == sorted(made["configById"])
    json.dumps(made, allow_nan=False)


_PATH = {"value", "enabled", "timestampMethod", "label", "color"}
_VIEW = {"cameraState", "followMode", "followTf", "scene", "publish", "transforms", "topics", "layers", "imageMode"}
_TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}
KEYS = {
    "3D": _VIEW,
    "Image": _VIEW,
    "Plot": {"paths", "showLegend", "legendDisplay", "showXAxisLabels", "showYAxisLabels", "isSynced", "xAxisVal"}
    | {"followingViewWidth"} | _TITLES,
    "StateTransitions": {"paths", "isSynced"},
    "RosOut": {"searchTerms", "minLogLevel", "topicToRender"},
    "RawMessages": {"topicPath", "diffEnabled"},
    "Publish": {"topicName", "datatype", "buttonText", "buttonTooltip", "advancedView", "value"},
    "cameraState": {"distance", "perspective", "phi", "target", "targetOffset", "targetOrientation", "thetaOffset"}
    | {"fovy", "near", "far"},
    "publish": {"type", "poseTopic", "pointTopic"},
    "imageMode": {"imageTopic"},
    "foxglove.Grid": {"layerId", "visible", "frameId", "size", "divisions"},
}  # fmt: skip
"""Keys by panel, as Lichtblick's source declares them (packages/suite-base/src/panels, of August 2026, 66adecb99)."""


@pytest.mark.parametrize("view", VIEWS)
def test_the_programs_know_every_key_of_the_panels(view: str) -> None:
    made = layout(view, parse_fleet(FLEETS[view]))
    assert set(made) == {"configById", "layout", "globalVariables", "userNodes", "playbackConfig"}
    objects = ("configById", "globalVariables", "userNodes", "playbackConfig")  # required by Lichtblick's import
    assert all(isinstance(made[name], dict) for name in objects)
    assert isinstance(made["playbackConfig"]["speed"], (int, float))
    for name, config in made["configById"].items():
        kind = name.partition("!")[0]
        assert set(config) <= KEYS[kind], name
        for part in ("cameraState", "publish", "imageMode"):
            assert set(config.get(part, {})) <= KEYS[part], name
        for layer in config.get("layers", {}).values():
            assert set(layer) <= KEYS[layer["layerId"]], name
        for path in config.get("paths", []):
            assert set(path) <= _PATH, name
            assert path["timestampMethod"] in ("receiveTime", "headerStamp")
        assert config.get("followMode", "follow-none") in ("follow-pose", "follow-position", "follow-none")
        assert config.get("publish", {}).get("type", "point") in ("pose_estimate", "pose", "point")


class _Master:
    """A parameter server."""

    def __init__(self, tree: dict[str, Any]) -> None:
        self.tree = tree
        self.calls: list[tuple[str, Any]] = []

    def getParam(self, _: str) -> Any:  # noqa: N802
        return self.tree

    def setParam(self, name: str, value: Any) -> None:  # noqa: N802
        self.calls.append((name, value))

    def deleteParam(self, name: str) -> None:  # noqa: N802
        self.calls.append((name, None))


def test_parameters_have_full_names_and_values_of_the_protocol() -> None:
    assert flat({"a": {"b": 1, "c": {}}, "d": "e"}) == {"/a/b": 1, "/a/c": {}, "/d": "e"}
    values = [True, 7, 1.5, "text", [1, 2], [1.5, "a"], {"x": [1]}, b"ab"]
    assert [to_parameter("/p", value).get_value() for value in values] == values
    assert to_parameter("/p", math.nan).get_value() == "nan"


def test_parameters_that_clients_may_set() -> None:
    master = _Master({"open": {"a": 1}, "closed": 2})
    parameters = RosParameters(lambda: master, ["/open/*"], operate=True)
    assert [p.name for p in parameters.get([])] == ["/open/a"]
    assert parameters.get(["/closed", "/open/none"]) == []
    parameters.set([Parameter("/open/a", value=5), Parameter("/open/b")])
    assert master.calls == [("/open/a", 5), ("/open/b", None)]
    for name, value, text in (
        ("/closed", 1, "'/closed' is not allowed, /open/*"),
        ("open/a", 1, "'open/a' is not allowed"),
        ("/open/a", 1 << 40, "1099511627776 is not allowed, 32 bits"),
    ):
        with pytest.raises(ParameterError, match="parameter") as refused:
            parameters.set([Parameter(name, value=value)])
        assert text in str(refused.value)
    with pytest.raises(ParameterError, match="read-only"):
        RosParameters(lambda: master, ["*"], operate=False).set([Parameter("/open/a", value=1)])


class _Channel:
    """A channel that keeps the logged messages."""

    def __init__(self, topic: str, **_: Any) -> None:
        self.topic = topic
        self.logged: list[bytes] = []
        self.closed = False

    def log(self, data: bytes, log_time: int) -> None:
        self.logged.append(data)

    def close(self) -> None:
        self.closed = True


class _Listener:
    def __init__(self, owner: list[Any]) -> None:
        self._owner = owner
        owner.append(self)

    def close(self) -> None:
        self._owner.remove(self)


class _Raw:
    """Counts subscriptions."""

    def __init__(self) -> None:
        self.listeners: list[Any] = []

    def listen(self, _: str, __: Any) -> _Listener:
        return _Listener(self.listeners)


def test_a_topic_is_subscribed_to_while_it_has_clients_and_there_is_a_channel_while_it_is_there() -> None:
    made: dict[str, _Channel] = {}
    told: list[str] = []
    raw = _Raw()

    def channel(topic: str, **options: Any) -> _Channel:
        assert options["schema"].encoding == "ros1msg"
        made[topic] = _Channel(topic)
        return made[topic]

    topics = TopicChannels(Context(), raw, lambda _, text: told.append(text), channel)  # type: ignore[arg-type]
    types = {"/a": "std_msgs/String", "/b": "nope/Nope"}
    for _ in range(2):
        topics.update(types)
    assert list(made) == ["/a"]
    assert len(told) == 1
    assert "/b is not offered: type: 'nope/Nope' is not installed" in told[0]

    for _ in range(2):
        topics.on_subscribe("/a")
    topics.on_unsubscribe("/a")
    _done(topics)
    assert len(raw.listeners) == 1
    topics.on_unsubscribe("/a")
    _done(topics)
    assert raw.listeners == []

    topics.on_subscribe("/a")
    _done(topics)
    topics.update({})
    assert made["/a"].closed
    _done(topics)
    assert raw.listeners == []
    topics.close()


def _done(topics: TopicChannels) -> None:
    """Wait for the thread of the channels."""
    topics._worker.submit(lambda: None).result()


COME_AND_GO = """
import json
import threading
import time

import foxglove
from foxglove import ConnectionGraph, Parameter
from foxglove.websocket import Capability
from websockets.sync.client import connect

from xtdrone_interaction.bridges.foxglove.foxglove_node import Listener
from xtdrone_interaction.bridges.foxglove.standing_client import PROTOCOL, StandingClient

listener = Listener(None, None, None, print)
capabilities = [Capability.Parameters, Capability.ConnectionGraph]
server = foxglove.start_server(
    port=0, capabilities=capabilities, server_listener=listener, context=foxglove.Context()
)
listener.standing = standing = StandingClient("127.0.0.1", server.port)
parameters = {"parameterNames": ["/number"]}
while not standing.answers():
    time.sleep(0.01)


def come_and_go(times):
    with connect(f"ws://127.0.0.1:{server.port}", subprotocols=[PROTOCOL], close_timeout=0.1) as socket:
        for begin in ("subscribe",) if not times else ("subscribe", "unsubscribe") * times:
            socket.send(json.dumps({"op": f"{begin}ConnectionGraph"}))
            socket.send(json.dumps({"op": f"{begin}ParameterUpdates", **parameters}))
        seen = set()
        for frame in socket:
            told = json.loads(frame)
            seen |= {topic["name"] for topic in told.get("publishedTopics", ())}
            seen |= {p["value"] for p in told.get("parameters", ())}
            if times or {"/last", "last"} <= seen:
                return


def tell(topic, value):
    made = ConnectionGraph()
    made.set_published_topic(topic, ["/node"])
    if standing.answers():
        server.publish_connection_graph(made)
        for _ in range(20):
            standing.tell_parameters([Parameter("/number", value=value)])


guests = [threading.Thread(target=come_and_go, args=(500,)) for _ in range(3)]
for guest in guests:
    guest.start()
number = 0
while any(guest.is_alive() for guest in guests):
    number += 1
    tell(f"/topic_{number}", str(number))
watcher = threading.Thread(target=come_and_go, args=(0,))
watcher.start()
while watcher.is_alive():
    tell("/last", "last")
standing.close()
server.stop()
print("told", number)
"""
"""In a process of its own, as what is tried would stop it for good."""


def test_the_graph_and_parameters_are_told_while_clients_come_and_go() -> None:
    done = subprocess.run([sys.executable, "-c", COME_AND_GO], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.removeprefix("told ")) > 1


def test_the_bridge_does_not_wait_for_a_server_that_does_not_answer() -> None:
    asked: queue.Queue[str] = queue.Queue()
    answer = threading.Event()

    def serve(socket: Any) -> None:
        for text in socket:
            request = json.loads(text)
            if request["op"] == "subscribeConnectionGraph":
                socket.send(json.dumps({"op": "connectionGraphUpdate"}))
                continue
            asked.put(request["id"])
            answer.wait()
            socket.send(json.dumps({"op": "parameterValues", "id": request["id"]}))

    with server.serve(serve, "127.0.0.1", 0, subprotocols=[PROTOCOL], close_timeout=0.1) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        standing = StandingClient("127.0.0.1", serving.socket.getsockname()[1])
        _until(lambda: standing.stands)
        assert not any(standing.answers() for _ in range(5))
        first = asked.get(timeout=_LIMIT)
        assert asked.empty(), "it is asked once"
        answer.set()
        _until(standing.answers)
        assert not (standing.answers() and asked.empty()), "an answer counts once"
        assert asked.get(timeout=_LIMIT) != first
        standing.close()
        serving.shutdown()
        thread.join()


def _until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + _LIMIT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)
