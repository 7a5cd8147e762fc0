"""ROS node of a cooperative search: the topics and services around ``search.mission``.

For each vehicle ``T`` (as ``typhoon_h480_0``):

==================================  =============================  ====================================================
topic or service                    type                           meaning
==================================  =============================  ====================================================
/T/mavros/state                     mavros_msgs/State              in
/T/mavros/local_position/pose       geometry_msgs/PoseStamped      in: position in the map frame
/T/mavros/mission/waypoints         mavros_msgs/WaypointList       in: mission and current item
/T/mavros/mission/reached           mavros_msgs/WaypointReached    in
/xtdrone/T/objects                  xtdrone_msgs/ObjectsOnGround   in: tracks of its camera
/xtdrone/T/camera_ok                std_msgs/Bool                  in: whether its images are new ones
/xtdrone/T/cmd_pose_enu             geometry_msgs/Pose             out: setpoints of a second look
/xtdrone/T/follow                   std_msgs/Int32                 out: track to follow, -1 for none
/T/mavros/mount_control/command     mavros_msgs/MountControl       out: camera pitch, for a look and after it
/T/mavros/set_mode, cmd/arming      SetMode, CommandBool           called
/T/mavros/mission/{pull,push,..}    WaypointPull, WaypointPush     called: read the mission; extend it
/T/mavros/param/set                 ParamSet                       called: height of the return
/xtdrone/search/event               std_msgs/String                out: JSON, see ``search.reports``
/xtdrone/search/progress            std_msgs/String                out: JSON, once a second
/xtdrone/search/coverage            nav_msgs/OccupancyGrid         out while it is subscribed to, once a second: 100
                                                                   seen, 0 not seen, -1 outside the region
==================================  =============================  ====================================================
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from geometry_msgs.msg import Pose, PoseStamped
from mavros_msgs.msg import MountControl, ParamValue, State, Waypoint, WaypointList, WaypointReached
from mavros_msgs.srv import CommandBool, ParamSet, SetMode, WaypointPull, WaypointPush, WaypointSetCurrent
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Bool, Int32, String
from xtdrone_msgs.msg import ObjectsOnGround

import xtdrone_lockstep as lockstep
from xtdrone_autopilot.navigator.plan import Items, PlanItem
from xtdrone_common.cameras.camera_pose import rotation_matrix
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments, needed_fleet
from xtdrone_common.programs.under_roslaunch import end_launch
from xtdrone_control.communication.setpoint import yaw_of

from .coverage_map import CoverageGrid
from .mission_control import SearchMission
from .people.candidates import Sighting
from .planning.plans import DatumSettings
from .planning.region import RegionError, read_region
from .search_settings import MissionSettings
from .searching_vehicle import Action, Arm, Follow, GoTo, PointCamera, PushMission, RequestMode, SetReturnHeight
from .searching_vehicle import State as VehicleState

EVENT_TOPIC = "/xtdrone/search/event"
PROGRESS_TOPIC = "/xtdrone/search/progress"
COVERAGE_TOPIC = "/xtdrone/search/coverage"
RATE = 10  # Hz
_PULL_PERIOD = 2.0  # s between requests for the mission of a vehicle that has none yet
_PROGRESS_PERIOD = 1.0  # s
_FINAL_STEPS = 10  # steps after the end, so that recorders receive the last events

Outcome = tuple[bool, str]


class Calls:
    """Service calls of one vehicle, in order.

    In lockstep a call blocks: the simulator waits, so its result always arrives in the same step. In real time a
    thread waits for the response while the steps continue.
    """

    def __init__(self, *, in_lockstep: bool) -> None:
        """Start the thread if one is needed.

        Args:
            in_lockstep: whether a simulator holds time while this node works.
        """
        self._executor = None if in_lockstep else ThreadPoolExecutor(max_workers=1)
        self._calls: list[tuple[Future[Any], Callable[[Any], None]]] = []

    def submit(self, call: Callable[[], Any], on_end: Callable[[Any], None]) -> None:
        """Start a call; :meth:`finish` passes its result to ``on_end``."""
        if self._executor is not None:
            self._calls.append((self._executor.submit(call), on_end))
            return
        done: Future[Any] = Future()
        done.set_result(call())
        self._calls.append((done, on_end))

    def finish(self) -> None:
        """Pass on the results of the calls that have ended."""
        while self._calls and self._calls[0][0].done():
            future, on_end = self._calls.pop(0)
            on_end(future.result())

    def close(self) -> None:
        """Cancel the calls that have not begun."""
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)


class VehicleLink:
    """Topics and services of one vehicle."""

    def __init__(self, name: str, node: SearchNode, *, in_lockstep: bool) -> None:
        """Declare the topics.

        Args:
            name: Name such as ``typhoon_h480_0``.
            node: receives the messages.
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

    def execute(self, action: Action, on_result: Callable[[Action, bool, str], None]) -> None:
        """Carry out an action; ``on_result`` receives the result of a service call."""
        match action:
            case GoTo():
                self._setpoint.publish(_pose(action))
            case Follow(track=track):
                self._follow.publish(Int32(data=track))
            case PointCamera(pitch=pitch):
                self._mount.publish(MountControl(mode=MountControl.MAV_MOUNT_MODE_MAVLINK_TARGETING, pitch=pitch))
            case _:
                self.calls.submit(partial(self._call, action), lambda outcome: on_result(action, *outcome))

    def pull(self) -> bool:
        """Request the vehicle's mission, which arrives as a topic; return whether the request was accepted."""
        return self._outcome(lambda: bool(self._services[WaypointPull]().success))[0]

    def _call(self, action: Action) -> Outcome:
        match action:
            case RequestMode(mode=mode):
                return self._outcome(lambda: bool(self._services[SetMode](0, mode).mode_sent))
            case Arm():
                return self._outcome(lambda: bool(self._services[CommandBool](True).success))
            case PushMission(items=items, current=current):
                return self._outcome(partial(self._push, items, current))
            case SetReturnHeight(height=height):
                value = ParamValue(integer=0, real=height)
                return self._outcome(lambda: bool(self._services[ParamSet]("RTL_RETURN_ALT", value).success))
            case _:
                raise TypeError(f"no service for {action}")

    def _push(self, items: Items, current: int) -> bool:
        if not self._services[WaypointPush](0, [to_waypoint(item) for item in items]).success:
            return False
        return bool(self._services[WaypointSetCurrent](current).success)

    def _outcome(self, call: Callable[[], bool]) -> Outcome:
        try:
            return (True, "") if call() else (False, "rejected by the autopilot")
        except (rospy.ROSException, rospy.ServiceException) as error:
            return False, f"{error}; is MAVROS running?"


def coverage_message(grid: CoverageGrid, height: float, stamp: rospy.Time) -> OccupancyGrid:
    """Return a coverage grid at a height, m, as a message in the map frame."""
    message = OccupancyGrid()
    message.header.stamp, message.header.frame_id = stamp, "map"
    message.info.resolution = grid.cell
    message.info.width, message.info.height = grid.values.shape
    message.info.origin.position.x, message.info.origin.position.y = grid.corner
    message.info.origin.position.z, message.info.origin.orientation.w = height, 1.0
    message.data = grid.values.T.ravel().tolist()
    return message


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
            make: creates the mission control; called again when time is reset.
            thing: class of the objects to search for; empty: any.
            out: folder with the events.jsonl that events are appended to; None: none.
            in_lockstep: whether a simulator holds time while this node works.
        """
        self._make = make
        self._thing = thing
        self._file = None if out is None else out / "events.jsonl"
        self.control = make()
        self._links = {name: VehicleLink(name, self, in_lockstep=in_lockstep) for name in self.control.vehicles}
        self._event = lockstep.Publisher(EVENT_TOPIC, String)
        self._progress = lockstep.Publisher(PROGRESS_TOPIC, String)
        self._coverage = lockstep.Publisher(COVERAGE_TOPIC, OccupancyGrid)
        self._pulled = -math.inf
        self._progress_published = -math.inf
        self._steps_left = _FINAL_STEPS
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        self.control = self._make()
        self._pulled = self._progress_published = -math.inf
        self._steps_left = _FINAL_STEPS

    @property
    def over(self) -> bool:
        """Whether the search has ended and its last events have been delivered."""
        return self._steps_left <= 0

    def step(self) -> None:
        """Run the mission control once, carry out its actions and publish its events."""
        now = _now()
        self._steps_left -= self.control.finished
        for link in self._links.values():
            link.calls.finish()
        self._pull(now)
        for action in self.control.step(now):
            self._links[action.vehicle].execute(action, self._on_result)
        for event in self.control.events():
            self._publish_event(event)
        if now - self._progress_published >= _PROGRESS_PERIOD - 1e-6:
            self._progress_published = now
            self._progress.publish(String(data=json.dumps(self.control.progress())))
            if self._coverage.get_num_connections():
                height = self.control.settings.ground
                self._coverage.publish(coverage_message(self.control.coverage.grid(), height, rospy.Time.now()))

    def close(self) -> None:
        """Cancel all service calls that have not begun."""
        for link in self._links.values():
            link.calls.close()

    def _pull(self, now: float) -> None:
        """Request the missions of waiting vehicles."""
        if now - self._pulled < _PULL_PERIOD:
            return
        self._pulled = now
        for name, vehicle in self.control.vehicles.items():
            if vehicle.state is VehicleState.WAITING and vehicle.connected and not vehicle.mission.items:
                self._links[name].calls.submit(self._links[name].pull, lambda _: None)

    def _on_result(self, action: Action, accepted: bool, reason: str) -> None:
        if not accepted:
            rospy.logwarn(f"{action.vehicle}: {type(action).__name__} {getattr(action, 'mode', '')}: {reason}")
        self.control.on_result(action, accepted, reason)

    def _publish_event(self, event: dict[str, Any]) -> None:
        line = json.dumps(event)
        rospy.loginfo(f"search: {line}")
        self._event.publish(String(data=line))
        if self._file is not None:
            with self._file.open("a", encoding="utf-8") as file:
                file.write(line + "\n")

    # messages

    def on_state(self, name: str, message: State) -> None:
        """Receive mavros/state."""
        self.control.on_state(name, message.mode, message.armed, message.connected, _now())

    def on_pose(self, name: str, message: PoseStamped) -> None:
        """Receive mavros/local_position/pose."""
        p, q = message.pose.position, message.pose.orientation
        self.control.on_pose(name, (p.x, p.y, p.z), yaw_of(q.x, q.y, q.z, q.w), _now())

    def on_waypoints(self, name: str, message: WaypointList) -> None:
        """Receive a vehicle's mission and its current item."""
        self.control.on_mission(name, tuple(to_item(waypoint) for waypoint in message.waypoints))
        self.control.on_item(name, message.current_seq)

    def on_reached(self, name: str, message: WaypointReached) -> None:
        """Receive mavros/mission/reached."""
        self.control.on_reached(name, message.wp_seq)

    def on_camera(self, name: str, message: Bool) -> None:
        """Receive whether the detector gets new images."""
        self.control.on_camera(name, message.data)

    def on_objects(self, name: str, message: ObjectsOnGround) -> None:
        """Receive the detections of an image."""
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
        norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w) or 1.0
        rotation = rotation_matrix((q.w / norm, q.x / norm, q.y / norm, q.z / norm))
        time = message.header.stamp.to_sec()
        self.control.on_picture(name, time, np.array([p.x, p.y, p.z]), rotation, sightings, _now())


def _now() -> float:
    return float(rospy.Time.now().to_sec())


def _pose(action: GoTo) -> Pose:
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = action.position
    pose.orientation.z, pose.orientation.w = math.sin(0.5 * action.yaw), math.cos(0.5 * action.yaw)
    return pose


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


# parameters and main loop


def settings_of(read: Callable[[str, Any], Any]) -> MissionSettings:
    """Read the settings from private parameters.

    Raises:
        ArgumentError: a parameter is out of range.
    """
    try:
        return MissionSettings.from_parameters(read)
    except ValueError as error:
        raise ArgumentError(str(error)) from error


def camera_of(read: Callable[[str, Any], Any]) -> Pinhole:
    """Read the camera from ``~camera`` (width, height, px; horizontal_fov, rad).

    Raises:
        ArgumentError: a value is invalid.
    """
    given = {"width": 640, "height": 360, "horizontal_fov": 2.0, **_mapping("~camera", read("~camera", {}))}
    try:
        return Pinhole.of_view(**given)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"~camera: {error}") from error


def datum_of(read: Callable[[str, Any], Any]) -> Datum:
    """Read the origin of the map frame from ``~datum`` (latitude, longitude, deg; altitude, m).

    Raises:
        ArgumentError: a value is invalid.
    """
    try:
        return DatumSettings(**_mapping("~datum", read("~datum", {})))
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"~datum: {error}") from error


def _mapping(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ArgumentError(f"{name}: {value!r} is not allowed, a mapping")
    return value


def run(arguments: Sequence[str]) -> None:
    """Run the node until the search has ended, or until shutdown.

    Raises:
        ArgumentError: an argument or a parameter is invalid.
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
        if node.over:
            end_launch()
    except rospy.ROSInterruptException:
        pass  # shutdown
    finally:
        node.close()
