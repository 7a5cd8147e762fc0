"""Mission control of a cooperative search as a ROS node: the topics and services around ``search.mission``.

For each vehicle ``T`` (as ``typhoon_h480_0``):

==================================  =============================  ====================================================
topic or service                    type                           meaning
==================================  =============================  ====================================================
/T/mavros/state                     mavros_msgs/State              in
/T/mavros/local_position/pose       geometry_msgs/PoseStamped      in: where it is, map frame
/T/mavros/mission/waypoints         mavros_msgs/WaypointList       in: which item it flies
/T/mavros/mission/reached           mavros_msgs/WaypointReached    in
/xtdrone/T/objects                  xtdrone_msgs/ObjectsOnGround   in: what its camera shows
/xtdrone/T/camera_ok                std_msgs/Bool                  in: whether its pictures are new ones
/xtdrone/T/cmd_pose_enu             geometry_msgs/Pose             out: setpoints of a second look
/xtdrone/T/follow                   std_msgs/Int32                 out: the track to follow, -1 for none
/T/mavros/mount_control/command     mavros_msgs/MountControl       out: the camera down, for a look and after it
/T/mavros/set_mode, cmd/arming      SetMode, CommandBool           called
/T/mavros/mission/{pull,push,..}    WaypointPull, WaypointPush     called: the mission that it has; more to fly
/T/mavros/param/set                 ParamSet                       called: the height of its return
/xtdrone/search/event               std_msgs/String                out: JSON, see ``search.mission``
/xtdrone/search/progress            std_msgs/String                out: JSON, once a second
==================================  =============================  ====================================================
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from geometry_msgs.msg import Pose, PoseStamped
from mavros_msgs.msg import MountControl, ParamValue, State, Waypoint, WaypointList, WaypointReached
from mavros_msgs.srv import CommandBool, ParamSet, SetMode, WaypointPull, WaypointPush, WaypointSetCurrent
from numpy.typing import NDArray
from std_msgs.msg import Bool, Int32, String
from xtdrone_msgs.msg import ObjectsOnGround

from xtdrone_control import lockstep
from xtdrone_control.autopilot.navigator.plan import Items, PlanItem
from xtdrone_control.communication.setpoint import yaw_of
from xtdrone_control.pinhole import Pinhole
from xtdrone_control.program import ArgumentError, check_no_arguments, needed_fleet

from .search import mission as control
from .search.evidence import Sighting
from .search.mission import Action, MissionSettings, SearchMission
from .search.plans import Datum
from .search.region import RegionError, read_region
from .search.vehicle import State as VehicleState

EVENT_TOPIC = "/xtdrone/search/event"
PROGRESS_TOPIC = "/xtdrone/search/progress"
RATE = 10  # Hz
_PULL_PERIOD = 2.0  # s between questions for the mission of a vehicle that has none yet
_PROGRESS_PERIOD = 1.0  # s
_LAST_TURNS = 10  # after the end, in which whoever records the search gets the last events

Outcome = tuple[bool, str]


class Calls:
    """Service calls of one vehicle, in order.

    In lockstep a call is made at once: the simulator waits, so the outcome falls into the same turn each time. In real
    time a thread of its own waits for the answer, and the turns go on.
    """

    def __init__(self, *, in_lockstep: bool) -> None:
        """Prepare.

        Args:
            in_lockstep: whether a simulator holds time while this node works.
        """
        self._executor = None if in_lockstep else ThreadPoolExecutor(max_workers=1)
        self._calls: list[tuple[Future[Any], Callable[[Any], None]]] = []

    def submit(self, call: Callable[[], Any], on_end: Callable[[Any], None]) -> None:
        """Start a call; ``on_end`` gets what it returns, in :meth:`finish`."""
        if self._executor is not None:
            self._calls.append((self._executor.submit(call), on_end))
            return
        done: Future[Any] = Future()
        done.set_result(call())
        self._calls.append((done, on_end))

    def finish(self) -> None:
        """Tell the outcomes of the calls that have ended."""
        while self._calls and self._calls[0][0].done():
            future, on_end = self._calls.pop(0)
            on_end(future.result())

    def close(self) -> None:
        """Let no further call begin."""
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)


class VehicleLink:
    """Topics and services of one vehicle."""

    def __init__(self, name: str, node: SearchNode, *, in_lockstep: bool) -> None:
        """Declare the topics.

        Args:
            name: as ``typhoon_h480_0``.
            node: who gets what comes.
            in_lockstep: see :class:`Calls`.
        """
        self.name = name
        self.calls = Calls(in_lockstep=in_lockstep)
        self._setpoint = lockstep.Publisher(f"/xtdrone/{name}/cmd_pose_enu", Pose)
        self._follow = lockstep.Publisher(f"/xtdrone/{name}/follow", Int32)
        base = f"/{name}/mavros"
        self._mount = lockstep.Publisher(f"{base}/mount_control/command", MountControl)
        for topic, kind, callback in (
            (f"{base}/state", State, node.on_state),
            (f"{base}/local_position/pose", PoseStamped, node.on_pose),
            (f"{base}/mission/waypoints", WaypointList, node.on_waypoints),
            (f"{base}/mission/reached", WaypointReached, node.on_reached),
            (f"/xtdrone/{name}/objects", ObjectsOnGround, node.on_objects),
            (f"/xtdrone/{name}/camera_ok", Bool, node.on_camera),
        ):
            lockstep.Subscriber(topic, kind, partial(callback, name))
        self._services = {
            kind: rospy.ServiceProxy(f"{base}/{service}", kind)
            for service, kind in (
                ("set_mode", SetMode),
                ("cmd/arming", CommandBool),
                ("mission/pull", WaypointPull),
                ("mission/push", WaypointPush),
                ("mission/set_current", WaypointSetCurrent),
                ("param/set", ParamSet),
            )
        }

    def obey(self, action: Action, on_result: Callable[[Action, bool, str], None]) -> None:
        """Carry out an action; ``on_result`` is told what came of those that are answered."""
        match action:
            case control.GoTo():
                self._setpoint.publish(_pose(action))
            case control.Follow(track=track):
                self._follow.publish(Int32(data=track))
            case control.Aim(pitch=pitch):
                self._mount.publish(MountControl(mode=MountControl.MAV_MOUNT_MODE_MAVLINK_TARGETING, pitch=pitch))
            case _:
                self.calls.submit(partial(self._call, action), lambda outcome: on_result(action, *outcome))

    def pull(self) -> bool:
        """Ask for the vehicle's mission, which then comes as a topic; return whether it was told."""
        return self._answer(lambda: bool(self._services[WaypointPull]().success))[0]

    def _call(self, action: Action) -> Outcome:
        match action:
            case control.SetMode(mode=mode):
                return self._answer(lambda: bool(self._services[SetMode](0, mode).mode_sent))
            case control.Arm():
                return self._answer(lambda: bool(self._services[CommandBool](True).success))
            case control.Push(items=items, current=current):
                return self._answer(partial(self._push, items, current))
            case control.ReturnHeight(height=height):
                value = ParamValue(integer=0, real=height)
                return self._answer(lambda: bool(self._services[ParamSet]("RTL_RETURN_ALT", value).success))
            case _:
                raise TypeError(f"no service is called for {action}")

    def _push(self, items: Items, current: int) -> bool:
        if not self._services[WaypointPush](0, [to_waypoint(item) for item in items]).success:
            return False
        return bool(self._services[WaypointSetCurrent](current).success)

    def _answer(self, call: Callable[[], bool]) -> Outcome:
        try:
            return (True, "") if call() else (False, "the autopilot refuses")
        except (rospy.ROSException, rospy.ServiceException) as error:
            return False, f"{error}; is MAVROS running?"


class SearchNode:
    """The mission control with its topics and services. Call :meth:`step` at 10 Hz."""

    def __init__(
        self,
        make: Callable[[], SearchMission],
        *,
        thing: str = "human",
        out: Path | None = None,
        in_lockstep: bool = False,
    ) -> None:
        """Declare the topics.

        Args:
            make: makes the mission control; again when time is set back.
            thing: the class of objects that is searched for; empty: any.
            out: folder to whose events.jsonl events are appended; None: none.
            in_lockstep: whether a simulator holds time while this node works.
        """
        self._make = make
        self._thing = thing
        self._file = None if out is None else out / "events.jsonl"
        self.control = make()
        self._links = {name: VehicleLink(name, self, in_lockstep=in_lockstep) for name in self.control.vehicles}
        self._event = lockstep.Publisher(EVENT_TOPIC, String)
        self._progress = lockstep.Publisher(PROGRESS_TOPIC, String)
        self._pulled = -math.inf
        self._told = -math.inf
        self._left = _LAST_TURNS
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        self.control = self._make()
        self._pulled = self._told = -math.inf
        self._left = _LAST_TURNS

    @property
    def over(self) -> bool:
        """Whether the search has ended, and all have had the time to hear of it."""
        return self._left <= 0

    def step(self) -> None:
        """Take what has come and let the mission control decide."""
        now = _now()
        self._left -= self.control.finished
        for link in self._links.values():
            link.calls.finish()
        self._pull(now)
        for action in self.control.step(now):
            self._links[action.vehicle].obey(action, self._on_result)
        for event in self.control.events():
            self._tell(event)
        if now - self._told >= _PROGRESS_PERIOD - 1e-6:
            self._told = now
            self._progress.publish(String(data=json.dumps(self.control.progress())))

    def close(self) -> None:
        """Call no more services."""
        for link in self._links.values():
            link.calls.close()

    def _pull(self, now: float) -> None:
        """Ask those that wait for their missions."""
        if now - self._pulled < _PULL_PERIOD:
            return
        self._pulled = now
        for name, vehicle in self.control.vehicles.items():
            if vehicle.state is VehicleState.WAITING and vehicle.connected and not vehicle.items:
                self._links[name].calls.submit(self._links[name].pull, lambda _: None)

    def _on_result(self, action: Action, accepted: bool, reason: str) -> None:
        if not accepted:
            rospy.logwarn(f"{action.vehicle}: {type(action).__name__} {_short(action)}: {reason}")
        self.control.on_result(action, accepted, reason)

    def _tell(self, event: dict[str, Any]) -> None:
        line = json.dumps(event)
        rospy.loginfo(f"search: {line}")
        self._event.publish(String(data=line))
        if self._file is not None:
            with self._file.open("a", encoding="utf-8") as file:
                file.write(line + "\n")

    # what comes

    def on_state(self, name: str, message: State) -> None:
        """Take mavros/state."""
        self.control.on_state(name, message.mode, message.armed, message.connected, _now())

    def on_pose(self, name: str, message: PoseStamped) -> None:
        """Take mavros/local_position/pose."""
        p, q = message.pose.position, message.pose.orientation
        self.control.on_pose(name, (p.x, p.y, p.z), yaw_of(q.x, q.y, q.z, q.w), _now())

    def on_waypoints(self, name: str, message: WaypointList) -> None:
        """Take the mission that a vehicle has, and which item it flies."""
        self.control.on_mission(name, tuple(to_item(waypoint) for waypoint in message.waypoints))
        self.control.on_item(name, message.current_seq)

    def on_reached(self, name: str, message: WaypointReached) -> None:
        """Take mavros/mission/reached."""
        self.control.on_reached(name, message.wp_seq)

    def on_camera(self, name: str, message: Bool) -> None:
        """Take whether the detector gets new pictures."""
        self.control.on_camera(name, message.data)

    def on_objects(self, name: str, message: ObjectsOnGround) -> None:
        """Take what the detector says of a picture."""
        p, q = message.camera.position, message.camera.orientation
        sightings = [
            Sighting(
                entry.id,
                (entry.position.x, entry.position.y),
                (entry.velocity.x, entry.velocity.y),
                (entry.covariance[0], entry.covariance[1], entry.covariance[3], entry.covariance[4]),
                entry.probability,
            )
            for entry in message.objects
            if self._thing in ("", entry.object_class)
        ]
        rotation = _rotation(q.x, q.y, q.z, q.w)
        time = message.header.stamp.to_sec()
        self.control.on_picture(name, time, np.array([p.x, p.y, p.z]), rotation, sightings, _now())


def _now() -> float:
    return float(rospy.Time.now().to_sec())


def _short(action: Action) -> str:
    return str(getattr(action, "mode", ""))


def _pose(action: control.GoTo) -> Pose:
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = action.position
    pose.orientation.z, pose.orientation.w = math.sin(0.5 * action.yaw), math.cos(0.5 * action.yaw)
    return pose


def _rotation(x: float, y: float, z: float, w: float) -> NDArray[np.float64]:
    """Return the rotation matrix of a quaternion."""
    norm = math.sqrt(x * x + y * y + z * z + w * w) or 1.0
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def to_item(waypoint: Waypoint) -> PlanItem:
    """Return a MAVROS waypoint as a mission item."""
    w = waypoint
    params = (w.param1, w.param2, w.param3, w.param4)
    return PlanItem(w.command, w.frame, params, w.x_lat, w.y_long, w.z_alt, w.autocontinue)


def to_waypoint(item: PlanItem) -> Waypoint:
    """Return a mission item as a MAVROS waypoint."""
    one, two, three, four = item.params
    return Waypoint(
        frame=item.frame,
        command=item.command,
        autocontinue=item.autocontinue,
        param1=one,
        param2=two,
        param3=three,
        param4=four,
        x_lat=item.x,
        y_long=item.y,
        z_alt=item.z,
    )


# the program


def settings_of(read: Callable[[str, Any], Any]) -> MissionSettings:
    """Return the settings from private parameters.

    Raises:
        ArgumentError: one is not allowed.
    """
    values = {f.name: read(f"~{f.name}", f.default) for f in fields(MissionSettings)}
    try:
        return MissionSettings(**values)
    except ValueError as error:
        raise ArgumentError(f"~{error}") from error


def camera_of(read: Callable[[str, Any], Any]) -> Pinhole:
    """Return the camera from ``~camera`` (width, height, px; horizontal_fov, rad).

    Raises:
        ArgumentError: it is not allowed.
    """
    given = {"width": 640, "height": 360, "horizontal_fov": 2.0, **_mapping("~camera", read("~camera", {}))}
    try:
        return Pinhole.of_view(**given)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"~camera: {error}") from error


def datum_of(read: Callable[[str, Any], Any]) -> Datum:
    """Return the map's origin from ``~datum`` (latitude, longitude, deg; altitude, m).

    Raises:
        ArgumentError: it is not allowed.
    """
    try:
        return Datum(**_mapping("~datum", read("~datum", {})))
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"~datum: {error}") from error


def _mapping(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ArgumentError(f"{name}: {value!r} is not allowed, a mapping")
    return value


def run(arguments: Sequence[str]) -> None:
    """Run the node until the search is over, or it is shut down.

    Raises:
        ArgumentError: an argument or a parameter is not allowed.
    """
    check_no_arguments(arguments)
    lockstep.init_node("search_mission", rate=RATE)
    fleet = needed_fleet(rospy.get_param("/xtdrone/fleet", None))
    path = str(rospy.get_param("~region", ""))
    try:
        region = read_region(path)
    except RegionError as error:
        raise ArgumentError(f"~region: {error}") from error
    names = [vehicle.name for vehicle in fleet]
    settings, camera, datum = settings_of(rospy.get_param), camera_of(rospy.get_param), datum_of(rospy.get_param)
    out = str(rospy.get_param("~out", ""))
    if out:
        Path(out).mkdir(parents=True, exist_ok=True)
    node = SearchNode(
        lambda: SearchMission(names, region, camera, settings, datum),
        thing=str(rospy.get_param("~class", "human")),
        out=Path(out) if out else None,
        in_lockstep=lockstep.is_active(),
    )
    lockstep.start()
    rate = lockstep.Rate()
    try:
        while not (rospy.is_shutdown() or node.over):
            node.step()
            rate.sleep()
    except rospy.ROSInterruptException:
        pass  # it is to end
    finally:
        node.close()
