"""The search node with a real master, in lockstep; run as a program, this file simulates the vehicles and detectors."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import xmlrpc.client
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from ros_master import RosMaster
from search_world import REGION, World, person

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_coordination.search import searching_vehicle as control
from xtdrone_coordination.search.planning.region import region_data
from xtdrone_coordination.search.search_settings import MissionSettings
from xtdrone_lockstep.server import LockstepServer

try:
    import rospy
    from geometry_msgs.msg import Pose, PoseStamped
    from mavros_msgs.msg import State, WaypointList
    from mavros_msgs.srv import CommandBool, ParamSet, SetMode, WaypointPull, WaypointPush, WaypointSetCurrent
    from scipy.spatial.transform import Rotation
    from std_msgs.msg import Int32
    from xtdrone_msgs.msg import ObjectOnGround, ObjectsOnGround

    from xtdrone_coordination.search import search_node
except ImportError:
    rospy = None

pytestmark = pytest.mark.skipif(rospy is None, reason="needs ROS 1 and the built workspace")

NODE = Path(__file__).parents[1] / "nodes" / "search_mission.py"
PATIENCE = 120.0  # s of wall time
COUNT = 2


class Topics:
    """Replaces the world's mission control: telemetry as topics, actions as services and topics."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._actions: list[Any] = []
        self._lock = threading.Lock()
        self._pushed: dict[str, Any] = {}
        self._items: dict[str, int] = {}
        self._out: dict[tuple[str, str], Any] = {}
        for name in world.bodies:
            base = f"/{name}/mavros"
            for topic, kind in (
                (f"{base}/state", State),
                (f"{base}/local_position/pose", PoseStamped),
                (f"{base}/mission/waypoints", WaypointList),
                (f"/xtdrone/{name}/objects", ObjectsOnGround),
            ):
                self._out[name, topic.rsplit("/", 1)[1]] = lockstep.Publisher(topic, kind)
            lockstep.Subscriber(f"/xtdrone/{name}/cmd_pose_enu", Pose, partial(self._on_pose, name))
            lockstep.Subscriber(f"/xtdrone/{name}/follow", Int32, partial(self._on_follow, name))
            for service, kind, act in (
                ("set_mode", SetMode, lambda name, r: control.RequestMode(name, r.custom_mode)),
                ("cmd/arming", CommandBool, lambda name, r: control.Arm(name)),
                ("param/set", ParamSet, lambda name, r: control.SetReturnHeight(name, r.value.real)),
                ("mission/pull", WaypointPull, self._pull),
                ("mission/push", WaypointPush, self._push),
                ("mission/set_current", WaypointSetCurrent, self._set_current),
            ):
                rospy.Service(f"{base}/{service}", kind, partial(self._serve, name, kind, act))

    def _serve(self, name: str, kind: Any, act: Callable[[str, Any], Any], request: Any) -> Any:
        with self._lock:
            action = act(name, request)
            if action is not None:
                self._actions.append(action)
        response = kind._response_class()
        for field in ("success", "mode_sent"):
            if hasattr(response, field):
                setattr(response, field, True)
        return response

    def _pull(self, name: str, _: Any) -> None:
        self._items.pop(name, None)

    def _push(self, name: str, request: Any) -> None:
        self._pushed[name] = tuple(search_node.to_item(waypoint) for waypoint in request.waypoints)

    def _set_current(self, name: str, request: Any) -> Any:
        return control.PushMission(name, self._pushed[name], request.wp_seq)

    def _on_pose(self, name: str, pose: Any) -> None:
        p, q = pose.position, pose.orientation
        self._act(control.GoTo(name, (p.x, p.y, p.z), search_node.yaw_of(q.x, q.y, q.z, q.w)))

    def _on_follow(self, name: str, message: Any) -> None:
        self._act(control.Follow(name, message.data))

    def _act(self, action: Any) -> None:
        with self._lock:
            self._actions.append(action)

    # called by the world

    def on_state(self, name: str, mode: str, armed: bool, connected: bool, _: float) -> None:
        self._out[name, "state"].publish(State(mode=mode, armed=armed, connected=connected))

    def on_pose(self, name: str, position: Any, yaw: float, _: float) -> None:
        self._out[name, "pose"].publish(PoseStamped(pose=search_node._pose(control.GoTo(name, position, yaw))))

    def on_item(self, name: str, current: int) -> None:
        with self._lock:
            known = self._items.get(name)
            self._items[name] = current
        if known != current:
            waypoints = [search_node.to_waypoint(item) for item in self._world.bodies[name].items]
            self._out[name, "waypoints"].publish(WaypointList(current_seq=current, waypoints=waypoints))

    def on_picture(self, name: str, time: float, position: Any, rotation: Any, sightings: Any, _: float) -> None:
        message = ObjectsOnGround(vehicle=name)
        message.header.stamp = rospy.Time.from_sec(time)
        p, q = message.camera.position, message.camera.orientation
        p.x, p.y, p.z = position
        q.x, q.y, q.z, q.w = Rotation.from_matrix(rotation).as_quat()
        for s in sightings:
            entry = ObjectOnGround(id=s.id, object_class="human", probability=s.probability)
            entry.position.x, entry.position.y = s.position
            entry.covariance[0] = entry.covariance[4] = 0.25
            message.objects.append(entry)
        message.objects.append(ObjectOnGround(id=9, object_class="car", probability=0.9))
        self._out[name, "objects"].publish(message)

    def step(self, _: float) -> list[Any]:
        with self._lock:
            actions, self._actions = self._actions, []
        return actions

    def events(self) -> list[Any]:
        return []

    def on_result(self, *_: Any) -> None:
        """Ignore results: the services have returned them."""


def stage() -> None:
    """Execute the actions of the search node in a world with a person and a car."""
    lockstep.init_node("stage", rate=10.0)
    world = World(count=COUNT, things=[person(100.0, 10.0)])
    world.control = Topics(world)  # type: ignore[assignment]
    lockstep.start()
    lockstep.spin(world.step)


@pytest.fixture
def master(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[xmlrpc.client.ServerProxy]:
    ros_master = RosMaster()
    monkeypatch.setenv("ROS_MASTER_URI", ros_master.uri)
    monkeypatch.setenv("ROS_HOSTNAME", "127.0.0.1")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)]))
    yield xmlrpc.client.ServerProxy(ros_master.uri)
    ros_master.close()


def _start(folder: Path, name: str, *command: str) -> subprocess.Popen:
    with open(folder / f"{name}.out", "w") as out:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT)


def _parameters(master: xmlrpc.client.ServerProxy, folder: Path, **changes: Any) -> None:
    region = folder / "region.yaml"
    region.write_text(yaml.safe_dump(region_data(REGION)), encoding="utf-8")
    master.setParam("/test", "/xtdrone/fleet", f"typhoon_h480:{COUNT}")
    for name, value in {"region": str(region), "out": str(folder), **changes}.items():
        master.setParam("/test", f"/search_mission/{name}", value)


def test_a_search_from_takeoff_to_landing(master: xmlrpc.client.ServerProxy, tmp_path: Path) -> None:
    config = yaml.safe_load((NODE.parents[1] / "config" / "search.yaml").read_text(encoding="utf-8"))
    _parameters(master, tmp_path, **{**config, "follow_time": 5.0})
    server = LockstepServer(hang_limit=PATIENCE)
    master.setParam("/test", "/lockstep/uri", server.uri)
    nodes = [
        _start(tmp_path, "stage", sys.executable, __file__),
        _start(tmp_path, "search", sys.executable, str(NODE), "__name:=search_mission"),
    ]
    events = tmp_path / "events.jsonl"

    def recorded() -> list[dict[str, Any]]:
        return [json.loads(line) for line in events.read_text().splitlines()] if events.exists() else []

    try:
        assert server.wait_for(["/stage", "/search_mission"], timeout=PATIENCE), (tmp_path / "search.out").read_text()
        now = server.next_due_us(-1)
        while now is not None and now < 400_000_000 and not (recorded() and recorded()[-1]["event"] == "finished"):
            server.tick(now)
            now = server.next_due_us(now)
        names = [event["event"] for event in recorded()]
        assert names[-1] == "finished", (names, (tmp_path / "search.out").read_text()[-2000:])
        for name in ("started", "candidate", "second_look", "confirmed", "following", "follow_ended"):
            assert name in names
        end = recorded()[-1]
        assert (end["outcome"], end["lost"]) == ("found", [])
        assert end["position"] == pytest.approx([100.0, 10.0], abs=0.5)
        assert end["covariance"] == [0.25, 0.0, 0.0, 0.25]
        last = 2_000_000 + now if now is not None else 0
        while now is not None and now < last:
            server.tick(now)
            now = server.next_due_us(now)
        assert nodes[1].wait(PATIENCE) == 0, "the node does not end after the search"
    finally:
        server.close()
        statuses = [node.wait(PATIENCE) for node in nodes]
    assert statuses == [0, 0]
    assert "Traceback" not in (tmp_path / "search.out").read_text()


def test_a_missing_region_file_is_reported(master: xmlrpc.client.ServerProxy, tmp_path: Path) -> None:
    _parameters(master, tmp_path, region="/nowhere/region.yaml")
    node = _start(tmp_path, "search", sys.executable, str(NODE), "__name:=search_mission")
    assert node.wait(PATIENCE) == 2
    assert "~region: /nowhere/region.yaml: " in (tmp_path / "search.out").read_text()


def test_invalid_parameters_are_reported() -> None:
    for read, name, value, what in (
        (search_node.settings_of, "~on_find", "wait", "~on_find: 'wait' is not allowed, hold, return or continue"),
        (search_node.camera_of, "~camera", {"horizontal_fov": 9.0}, "~camera: horizontal_fov: 9.0 is not allowed"),
        (search_node.camera_of, "~camera", "wide", "~camera: 'wide' is not allowed, a mapping"),
        (search_node.datum_of, "~datum", {"latitude": 95.0}, "~datum: latitude: 95.0 is not allowed"),
    ):
        with pytest.raises(ArgumentError) as raised:
            read(lambda asked, default, name=name, value=value: value if asked == name else default)
        assert what in str(raised.value)


def test_the_configuration_names_every_setting_with_its_default() -> None:
    config = yaml.safe_load((NODE.parents[1] / "config" / "search.yaml").read_text(encoding="utf-8"))
    settings = vars(MissionSettings())
    assert {name: value for name, value in config.items() if name not in ("class", "camera")} == settings


if __name__ == "__main__":
    stage()
