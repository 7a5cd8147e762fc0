"""ROS node that publishes the markers of a swarm; see ``nodes/swarm_markers.py``."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped, Vector3
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Float32MultiArray, Int32MultiArray, String
from visualization_msgs.msg import MarkerArray
from xtdrone_msgs.msg import ObjectsOnGround, SceneModels

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import Pose
from xtdrone_common.programs.node_command_line import check_no_arguments, needed_fleet
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.recording.distances import offsets_from_message
from xtdrone_interaction.recording.topics import PATTERN_TOPIC, TOPOLOGY_TOPIC, TRUTH_TOPIC
from xtdrone_interaction.rviz.markers import TRAIL, SwarmMarkers, ground_view
from xtdrone_interaction.rviz.view_configurations import FOR_MARKERS
from xtdrone_interaction.rviz.world_markers import WorldMarkers
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.worlds.sdf import load_world_file, read_world

NAME = "swarm_markers"
TOPIC = "/xtdrone/markers"
SEARCH_EVENTS = "/xtdrone/search/event"
CAMERA = "cgo3_camera"  # of the searching vehicles


@dataclass(frozen=True)
class MarkerSettings(Settings):
    """Private parameters of the node."""

    rate: float = setting(30.0, low=0.1, high=50.0, unit="Hz", text="publishing rate in simulated time")
    trail: float = setting(TRAIL, low=0.0, high=60.0, unit="s", text="length of the trails")
    scale: float = setting(1.0, low=0.1, high=50.0, text="scale of text and line widths; at 1, letters are 0.4 m high")
    spot: float = setting(
        0.0, low=0.0, high=50.0, unit="m", text="diameter of a sphere around each vehicle for distant views; 0: none"
    )


class MarkersNode:
    """Subscribes to the swarm and the world's models and people, and publishes their markers."""

    def __init__(self, markers: SwarmMarkers, cameras: Mapping[str, Collection[str]]) -> None:
        """Advertise and subscribe.

        Args:
            markers: of the swarm.
            cameras: names of each vehicle's cameras, by the vehicle's name.
        """
        self._markers = markers
        self._world: WorldMarkers | None = None
        self._states: ModelStates | None = None
        self._changes: SceneModels | None = None  # received before the world
        self._subscribers = 0
        self._lenses: dict[str, CameraInfo] = {}
        self._publisher = lockstep.Publisher(TOPIC, MarkerArray)
        for name in markers.names:
            lockstep.Subscriber(f"/{name}/mavros/local_position/pose", PoseStamped, partial(self._on_pose, name))
            for mode in ("vel", "accel"):
                lockstep.Subscriber(f"/xtdrone/{name}/avoid_{mode}", Vector3, partial(self._on_avoidance, name))
            if cameras[name]:
                lockstep.Subscriber(f"/xtdrone/{name}/objects", ObjectsOnGround, partial(self._on_objects, name))
            if CAMERA in cameras[name]:
                info = f"/{name}/{CAMERA}/camera_info"
                lockstep.Subscriber(info, CameraInfo, partial(self._lenses.__setitem__, name))
        lockstep.Subscriber(PATTERN_TOPIC, Float32MultiArray, self._on_pattern)
        lockstep.Subscriber(TOPOLOGY_TOPIC, Int32MultiArray, self._on_topology)
        lockstep.Subscriber(SEARCH_EVENTS, String, self._on_search_event)
        lockstep.Subscriber(TRUTH_TOPIC, ModelStates, self._on_states, queue_size=1)
        lockstep.Subscriber("/xtdrone/models", SceneModels, self._on_models)
        lockstep.add_reset_hook(self._restart)

    def show_world(self, world: WorldMarkers) -> None:
        """Add a world's models and people."""
        self._world = world
        if world.has_models:
            self._markers.stand_out()
        if self._changes is not None:
            self._on_models(self._changes)

    def _restart(self) -> None:
        self._markers.restart()
        self._states = None
        self._subscribers = 0

    def step(self) -> None:
        """Publish the markers if the topic has subscribers; a new subscriber receives the whole world."""
        count = self._publisher.get_num_connections()
        if not count:
            self._subscribers = 0
            return
        array = self._markers.array(rospy.get_time())
        if self._world is not None:
            if count > self._subscribers:
                self._world.restart()
            if self._states is not None:
                self._world.on_poses(_poses(self._states))
                self._states = None
            array.markers += self._world.changes(array.markers[0].header)
        self._subscribers = count
        self._publisher.publish(array)

    def _on_states(self, message: ModelStates) -> None:
        self._states = message

    def _on_models(self, message: SceneModels) -> None:
        if self._world is None:
            self._changes = message
            return
        added = read_world(message.sdf, Path(str(rospy.get_param("/xtdrone/world", "")))).models
        self._world.on_models(added, message.deleted)

    def _on_pose(self, name: str, message: PoseStamped) -> None:
        p = message.pose.position
        self._markers.on_position(name, message.header.stamp.to_sec(), (p.x, p.y, p.z))

    def _on_avoidance(self, name: str, message: Vector3) -> None:
        self._markers.on_avoidance(name, (message.x, message.y, message.z))

    def _on_pattern(self, message: Float32MultiArray) -> None:
        self._markers.on_pattern(offsets_from_message(message.data))

    def _on_topology(self, message: Int32MultiArray) -> None:
        self._markers.on_topology(np.asarray(message.data))

    def _on_objects(self, name: str, message: Any) -> None:
        p, q = message.camera.position, message.camera.orientation
        feet = [(o.position.x, o.position.y, o.position.z) for o in message.objects]
        self._markers.on_detections(name, (p.x, p.y, p.z), feet)
        lens = self._lenses.get(name)
        if lens is not None:
            size = (lens.width, lens.height)
            corners = ground_view((p.x, p.y, p.z), (q.w, q.x, q.y, q.z), (lens.K[0], lens.K[4]), size)
            self._markers.on_view(name, corners)

    def _on_search_event(self, message: String) -> None:
        event = json.loads(message.data)
        if event.get("event") == "confirmed":
            x, y = event["position"][:2]
            self._markers.on_find((x, y), f"found by {event['vehicle']}")


def _poses(message: ModelStates) -> dict[str, Pose]:
    places = ((name, pose.position, pose.orientation) for name, pose in zip(message.name, message.pose, strict=True))
    return {name: Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z)) for name, p, q in places}


def _cameras(vehicle: Vehicle) -> list[str]:
    return [camera.name for camera in load_vehicle(vehicle.model).cameras if camera.kind == "rgb"]


def _world_markers() -> WorldMarkers | None:
    """Return the markers of the world; warn and return None if they cannot be made."""
    name = str(rospy.get_param("/xtdrone/world", ""))  # the simplified simulator has none
    if not name:
        return None
    try:
        return WorldMarkers(load_world_file(name))
    except (OSError, ValueError) as error:
        rospy.logwarn(f"world {name} is not shown: {error}")
        return None


def main(arguments: Sequence[str]) -> None:
    """Run the node until shutdown.

    Raises:
        ArgumentError: invalid arguments or fleet.
        SettingError: a parameter is not allowed.
    """
    check_no_arguments(arguments)
    fleet = needed_fleet(rospy.get_param("/xtdrone/fleet", None))
    private = f"{lockstep.future_name(NAME)}/"
    of_view = FOR_MARKERS.get(str(rospy.get_param(f"{private}view", "")), {})

    def get(name: str, default: Any) -> Any:
        return rospy.get_param(name, of_view.get(name.removeprefix(private), default))

    settings = MarkerSettings.from_parameters(get, private)
    lockstep.init_node(NAME, rate=settings.rate)
    markers = SwarmMarkers([vehicle.name for vehicle in fleet], settings.trail, settings.scale, settings.spot)
    node = MarkersNode(markers, {vehicle.name: _cameras(vehicle) for vehicle in fleet})
    lockstep.start()  # returns when the simulator is running and has set the world
    world = _world_markers()
    if world is not None:
        node.show_world(world)
    lockstep.spin(node.step)
