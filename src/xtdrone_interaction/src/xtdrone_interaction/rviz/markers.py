"""Markers of a swarm for rviz, without a ROS node.

All markers are in the ``map`` frame, ENU, metres, with a namespace per kind, which can be switched in rviz:

=============  ==============  =====================================================================================
namespace      type            what it shows
=============  ==============  =====================================================================================
names          text            each vehicle's name above it
spots          sphere          each vehicle's position, for views from too far away to see the vehicle
trails         line strip      path of each vehicle in the last seconds
slots          spheres         the followers' slots in the pattern, relative to the leader
topology       line list       communication links, from the sender (dark) to the receiver (bright)
avoidance      arrow           the avoidance of each vehicle, before its gain
views          line list       each camera's view of the ground
detections     cylinder        detected objects, as high as a person
sightlines     line list       from each camera to its detections
finds          cylinder, text  confirmed finds of the search
=============  ==============  =====================================================================================
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import rospy
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from xtdrone_common.cameras.camera_pose import rotation_matrix

Array = NDArray[np.float64]
Place = tuple[float, float, float]

FRAME = "map"
TRAIL = 6.0  # s
_LABEL = 0.4  # m
_TRAIL_STEP = 0.15  # m between two points of a trail
_TRAIL_POINTS = 400
_LEAST_ARROW = 0.05  # m; shorter arrows are left out
_PERSON = (0.6, 1.8)  # m, width and height of a detection's cylinder
_FIND = (1.2, 30.0)  # m, visible from far away
_MOST_VIEW = 150.0  # m, longest distance from the camera to a corner of its view

_DARK = ColorRGBA(0.10, 0.12, 0.16, 1.0)
_LIGHT = ColorRGBA(1.0, 1.0, 1.0, 1.0)
_SLOT = ColorRGBA(0.10, 0.60, 0.25, 0.30)
_LIGHT_SLOT = ColorRGBA(0.80, 1.00, 0.55, 0.45)
_HEARD = ColorRGBA(0.35, 0.40, 0.55, 0.9)
_LISTENS = ColorRGBA(0.25, 0.60, 1.00, 0.9)
_AVOIDS = ColorRGBA(0.90, 0.10, 0.10, 1.0)
_DETECTED = ColorRGBA(0.95, 0.50, 0.00, 0.9)
_FOUND = ColorRGBA(0.85, 0.05, 0.25, 0.6)


@dataclass
class _Vehicle:
    position: Place | None = None
    trail: deque[tuple[float, Place]] = field(default_factory=lambda: deque(maxlen=_TRAIL_POINTS))
    avoidance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera: Place | None = None
    detections: tuple[Place, ...] = ()
    view: Array = field(default_factory=lambda: np.empty((0, 3)))


def ground_view(
    position: Sequence[float], orientation: Sequence[float], focal: tuple[float, float], size: tuple[int, int]
) -> Array:
    """Return the corners of a camera's view of the ground z = 0, shape (4, 3), m; (0, 3) if it includes the horizon.

    Args:
        position: of the camera, m ENU.
        orientation: quaternion (w, x, y, z) of its optical frame: z ahead, x right, y down.
        focal: focal lengths along x and y, pixels.
        size: width and height of the picture, pixels; the optical axis goes through its middle.
    """
    right, down = 0.5 * size[0] / focal[0], 0.5 * size[1] / focal[1]
    ahead = np.array([[-right, -down, 1.0], [right, -down, 1.0], [right, down, 1.0], [-right, down, 1.0]])
    rays: Array = ahead @ rotation_matrix(orientation).T
    height = float(position[2])
    if height <= 0.0 or not (rays[:, 2] < 0.0).all():
        return np.empty((0, 3))
    reach = -height / rays[:, 2]
    if (reach * np.linalg.norm(rays, axis=1)).max() > _MOST_VIEW:
        return np.empty((0, 3))
    corners = np.asarray(position, dtype=float) + reach[:, None] * rays
    corners[:, 2] = 0.0
    return corners


class SwarmMarkers:
    """Collects the latest states and creates markers.

    Attributes:
        names: of the vehicles; the first leads a formation.
    """

    def __init__(self, names: Sequence[str], trail: float = TRAIL, scale: float = 1.0, spot: float = 0.0) -> None:
        """Start without states.

        Args:
            names: of the vehicles.
            trail: length of the trails, s; 0 for none.
            scale: of text and line widths; at 1 letters are 0.4 m high, readable from 15 m.
            spot: diameter of the spheres around the vehicles, m; 0 for none.

        Raises:
            ValueError: no vehicles, or an invalid size.
        """
        if not names:
            raise ValueError("markers: there are no vehicles")
        if not (math.isfinite(trail) and trail >= 0.0):
            raise ValueError(f"markers: trail of {trail!r} s is not allowed, 0 or more")
        if not (math.isfinite(scale) and scale > 0.0):
            raise ValueError(f"markers: scale {scale!r} is not allowed, above 0")
        if not (math.isfinite(spot) and spot >= 0.0):
            raise ValueError(f"markers: spots of {spot!r} m are not allowed, 0 or more")
        self.names = tuple(names)
        self._trail = trail
        self._scale = scale
        self._spot = spot
        self._ink, self._slot_colour = _DARK, _SLOT
        self._colours = [_colour(i) for i in range(len(names))]
        self.restart()

    def restart(self) -> None:
        """Reset all states after simulated time has gone back; the next array removes all markers."""
        self._vehicles = {name: _Vehicle() for name in self.names}
        self._offsets: Array = np.empty((0, 3))
        self._edges: list[tuple[str, str]] = []
        self._finds: list[tuple[tuple[float, float], str]] = []
        self._clear = True
        self._things_shown = 0

    def stand_out(self) -> None:
        """Use light colours for names and slots, before scenery."""
        self._ink, self._slot_colour = _LIGHT, _LIGHT_SLOT

    # inputs

    def on_position(self, name: str, time: float, position: Place) -> None:
        """Store the position of a vehicle, m ENU, at a time, s."""
        vehicle = self._vehicles[name]
        vehicle.position = position
        last = vehicle.trail[-1][1] if vehicle.trail else (math.inf,) * 3
        if math.dist(last, position) >= _TRAIL_STEP:
            vehicle.trail.append((time, position))

    def on_pattern(self, offsets: Array) -> None:
        """Store the followers' slots relative to the leader, shape (n - 1, 3), m; (0, 3) for no pattern."""
        self._offsets = np.asarray(offsets, dtype=float).reshape(-1, 3)

    def on_topology(self, adjacency: Array) -> None:
        """Store the communication topology.

        Args:
            adjacency: shape (n, n); row i has the vehicles that vehicle i receives; may be empty.

        Raises:
            ValueError: wrong size.
        """
        count = len(self.names)
        if adjacency.size not in (0, count * count):
            raise ValueError(f"topology: {adjacency.size} values are not allowed, {count} x {count} for these vehicles")
        matrix = adjacency.reshape(-1, count)
        self._edges = [(self.names[j], self.names[i]) for i, j in np.argwhere(matrix)]

    def on_avoidance(self, name: str, vector: tuple[float, float, float]) -> None:
        """Store the avoidance vector of a vehicle, ENU."""
        self._vehicles[name].avoidance = vector

    def on_detections(self, name: str, camera: Place, feet: Sequence[Place]) -> None:
        """Store the ground positions of a vehicle's latest detections and the position of its camera, m ENU."""
        self._vehicles[name].camera = camera
        self._vehicles[name].detections = tuple(feet)

    def on_view(self, name: str, corners: Array) -> None:
        """Store the view of a vehicle's camera on the ground, shape (4, 3), m ENU; (0, 3) for none."""
        self._vehicles[name].view = corners

    def on_find(self, place: tuple[float, float], words: str) -> None:
        """Store a confirmed find, x and y in m ENU."""
        self._finds.append((place, words))

    # output

    def array(self, time: float) -> MarkerArray:
        """Return all markers.

        Args:
            time: stamp, s.
        """
        stamp = rospy.Time.from_sec(time)
        markers: list[Marker] = []
        if self._clear:
            self._clear = False
            markers.append(Marker(action=Marker.DELETEALL))
        markers += [self._slots(), self._topology(), self._sightlines()]
        for number, (name, vehicle) in enumerate(self._vehicles.items()):
            if vehicle.position is not None:
                markers += self._of_vehicle(number, name, vehicle, time)
        markers += self._things()
        for number, (place, words) in enumerate(self._finds):
            markers += _find(number, place, words)
        for marker in markers:
            marker.header = Header(stamp=stamp, frame_id=FRAME)
        return MarkerArray(markers)

    def _of_vehicle(self, number: int, name: str, vehicle: _Vehicle, time: float) -> list[Marker]:
        assert vehicle.position is not None
        colour = self._colours[number]
        x, y, z = vehicle.position
        label = self._scale * _LABEL
        text = _marker("names", number, Marker.TEXT_VIEW_FACING, self._ink, Vector3(0.0, 0.0, label))
        text.pose.position = Point(x, y, z + max(0.3, 0.5 * self._spot) + 0.75 * label)
        text.text = name
        made = [text]
        if self._spot > 0.0:
            see_through = ColorRGBA(colour.r, colour.g, colour.b, 0.7)
            sphere = _marker("spots", number, Marker.SPHERE, see_through, Vector3(self._spot, self._spot, self._spot))
            sphere.pose.position = Point(x, y, z)
            made.append(sphere)
        if self._trail > 0.0:
            while vehicle.trail and vehicle.trail[0][0] < time - self._trail:
                vehicle.trail.popleft()
            trail = _marker("trails", number, Marker.LINE_STRIP, colour, self._width(0.05))
            trail.points = [*(Point(*place) for _, place in vehicle.trail), Point(x, y, z)]
            made.append(_or_none(trail, len(trail.points) > 1))
        arrow = _marker("avoidance", number, Marker.ARROW, _AVOIDS, Vector3(0.06, 0.16, 0.0))
        dx, dy, dz = vehicle.avoidance
        arrow.points = [Point(x, y, z), Point(x + dx, y + dy, z + dz)]
        made.append(_or_none(arrow, math.hypot(dx, dy, dz) >= _LEAST_ARROW))
        view = _marker("views", number, Marker.LINE_LIST, colour, Vector3(max(1.0, self._scale) * 0.06, 0.0, 0.0))
        # The ground is far away in any view; a little above it, for a grid may lie there. A strip would taper at its
        # corners.
        corners = [Point(x, y, z + 0.05) for x, y, z in vehicle.view]
        view.points = [corner for k in range(len(corners)) for corner in (corners[k - 1], corners[k])]
        made.append(_or_none(view, len(vehicle.view) > 0))
        return made

    def _width(self, width: float) -> Vector3:
        return Vector3(self._scale * width, 0.0, 0.0)

    def _slots(self) -> Marker:
        slots = _marker("slots", 0, Marker.SPHERE_LIST, self._slot_colour, Vector3(0.7, 0.7, 0.7))
        leader = self._vehicles[self.names[0]].position
        if leader is not None:
            slots.points = [Point(*place) for place in np.add(leader, self._offsets)]
        return _or_none(slots, len(slots.points) > 0)

    def _topology(self) -> Marker:
        lines = _marker("topology", 0, Marker.LINE_LIST, _LISTENS, self._width(0.04))
        for heard, listener in self._edges:
            begin, end = self._vehicles[heard].position, self._vehicles[listener].position
            if begin is not None and end is not None:
                lines.points += [Point(*begin), Point(*end)]
                lines.colors += [_HEARD, _LISTENS]
        return _or_none(lines, len(lines.points) > 0)

    def _sightlines(self) -> Marker:
        lines = _marker("sightlines", 0, Marker.LINE_LIST, _DETECTED, self._width(0.05))
        for vehicle in self._vehicles.values():
            for foot in vehicle.detections:
                if vehicle.camera is not None:
                    lines.points += [Point(*vehicle.camera), Point(*foot)]
        return _or_none(lines, len(lines.points) > 0)

    def _things(self) -> list[Marker]:
        """Return a cylinder for each detection, and the deletion of earlier ones."""
        feet = [foot for vehicle in self._vehicles.values() for foot in vehicle.detections]
        width, height = _PERSON
        gone = range(len(feet), self._things_shown)
        made = [Marker(ns="detections", id=number, action=Marker.DELETE) for number in gone]
        self._things_shown = len(feet)
        for number, (x, y, z) in enumerate(feet):
            body = _marker("detections", number, Marker.CYLINDER, _DETECTED, Vector3(width, width, height))
            body.pose.position = Point(x, y, z + 0.5 * height)
            made.append(body)
        return made


def _find(number: int, place: tuple[float, float], words: str) -> list[Marker]:
    width, height = _FIND
    column = _marker("finds", 2 * number, Marker.CYLINDER, _FOUND, Vector3(width, width, height))
    column.pose.position = Point(*place, 0.5 * height)
    text = _marker("finds", 2 * number + 1, Marker.TEXT_VIEW_FACING, _DARK, Vector3(0.0, 0.0, 3.0))
    text.pose.position = Point(*place, height + 2.5)
    text.text = words
    return [column, text]


def _marker(namespace: str, number: int, kind: int, colour: ColorRGBA, scale: Vector3) -> Marker:
    pose = Pose(Point(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
    return Marker(ns=namespace, id=number, type=kind, action=Marker.ADD, pose=pose, scale=scale, color=colour)


def _or_none(marker: Marker, shown: bool) -> Marker:
    """Return the marker, or its deletion, because rviz rejects lists without points."""
    return marker if shown else Marker(ns=marker.ns, id=marker.id, type=marker.type, action=Marker.DELETE)


def _colour(number: int) -> ColorRGBA:
    """Return the colour of a vehicle; hues follow the golden ratio, so that neighbours differ."""
    hue = (0.6 + number * 0.618034) % 1.0
    red, green, blue = (0.75 * min(1.0, max(0.0, abs(((hue + k / 3.0) % 1.0) * 6.0 - 3.0) - 1.0)) for k in (3, 2, 1))
    return ColorRGBA(red, green, blue, 1.0)
