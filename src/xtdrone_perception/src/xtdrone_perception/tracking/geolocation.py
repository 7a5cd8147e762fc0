"""Geolocation: position on the ground of a person detected as a box.

A person is modelled as a standing cylinder. The lower edge of its box is not its foot: from steeply above, the near rim
of its top lies lower in the image. Position, height and radius are therefore estimated together, so that the
cylinder's box matches the detected one, with the usual height and radius of people as the prior (a Gauss-Newton step is
a Kalman update). Sides of a box cut off by the edge of the image are not used.

The covariance has two parts: the error independent in every image (pixels, and the swaying attitude), and the error
shared by the images of a vehicle (its position, the height of the person), which averaging does not reduce.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.camera_pose import rotation_matrix
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.settings import Settings, check_range, setting

Array = NDArray[np.float64]
Ground = Callable[[float, float], float]

_STEPS = 8  # of Gauss-Newton; three suffice except for boxes that are cut off
_SETTLED = 1e-4  # m
_EDGE = 1.0  # px; a box this close to the image's edge may be cut off
_DELTA = np.array([1e-3, 1e-3, 1e-3, 1e-3])  # m, for derivatives with respect to position, height and radius
_POSE_DELTA = np.array([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])  # m, rad


@dataclass(frozen=True)
class Person(Settings):
    """Cylinder model of a person; standard deviations end in ``_noise``."""

    height: float = setting(1.7, low=0.1, high=10.0, unit="m", text="height of the cylinder")
    height_noise: float = setting(0.15, low=1e-3, high=10.0, unit="m", text="standard deviation of ``height``")
    radius: float = setting(0.3, low=0.01, high=10.0, unit="m", text="radius of the cylinder")
    radius_noise: float = setting(0.1, low=1e-3, high=10.0, unit="m", text="standard deviation of ``radius``")


@dataclass(frozen=True)
class Noise(Settings):
    """Standard deviations of an image and its pose."""

    pixel: float = setting(1.5, low=1e-3, high=100.0, unit="px", text="each side of a box")
    tilt: float = setting(0.01, low=0.0, high=100.0, unit="rad", text="camera attitude about horizontal axes")
    heading: float = setting(0.03, low=0.0, high=100.0, unit="rad", text="camera attitude about the vertical axis")
    horizontal: float = setting(0.4, low=0.0, high=100.0, unit="m", text="horizontal camera position, each axis")
    vertical: float = setting(0.4, low=0.0, high=100.0, unit="m", text="vertical camera position")
    ground: float = setting(0.1, low=0.0, high=100.0, unit="m", text="height of the ground")


@dataclass(frozen=True)
class View:
    """An image's camera: ``position`` (3,) m in map, and ``rotation`` (3, 3) from the optical frame to map."""

    pinhole: Pinhole
    position: Array
    rotation: Array

    @staticmethod
    def of(pinhole: Pinhole, position: tuple[float, float, float], orientation: tuple[float, ...]) -> View:
        """Return the view from a pose of the optical frame, quaternion (w, x, y, z)."""
        return View(pinhole, np.array(position, float), rotation_matrix(orientation))


@dataclass(frozen=True)
class GroundPoint:
    """A position on the ground.

    Attributes:
        position: (3,) of the foot, m, map.
        independent: (3, 3) covariance of the error independent in every image, m^2.
        shared: (3, 3) covariance of the error shared by the images of a vehicle, m^2.
    """

    position: Array
    independent: Array
    shared: Array

    @property
    def covariance(self) -> Array:
        """Total covariance, (3, 3) m^2."""
        return self.independent + self.shared


class Geolocator:
    """Locates people on the ground from their boxes."""

    def __init__(
        self,
        ground: float | Ground = 0.0,
        person: Person | None = None,
        noise: Noise | None = None,
        *,
        farthest: float = 200.0,
        least_dip: float = math.radians(3.0),
    ) -> None:
        """Set the priors.

        Args:
            ground: height of flat ground, m, map; or a function of x and y that returns the height.
            person: cylinder model; None: the default.
            noise: None: the default.
            farthest: maximum distance from the camera, 1 to 10000 m.
            least_dip: rays less than this below the horizon are rejected, 0.001 to 1.5 rad.

        Raises:
            ValueError: a value is out of range.
        """
        self.person = person or Person()
        self.noise = noise or Noise()
        self._ground: Ground = ground if callable(ground) else _flat(check_range("ground", ground, -1e4, 1e4, "m"))
        self._farthest = check_range("farthest", farthest, 1.0, 10_000.0, "m")
        self._least_dip = check_range("least_dip", least_dip, 0.001, 1.5, "rad")

    def point(self, view: View, pixel: tuple[float, float]) -> Array | None:
        """Return the intersection of a pixel's ray with the ground, (3,) m, map.

        Returns:
            None if the ray is too close to the horizon, or hits the ground too far away.
        """
        return self._hit(view, pixel, 0.0)

    def locate(self, view: View, box: tuple[float, float, float, float]) -> GroundPoint | None:
        """Return the position of the person in a box.

        Args:
            view: camera of the image.
            box: xmin, ymin, xmax, ymax, px.

        Returns:
            None if the box is not on the ground within range.
        """
        seen = np.asarray(box, float)
        start = self._hit(view, (0.5 * (seen[0] + seen[2]), 0.5 * (seen[1] + seen[3])), 0.5 * self.person.height)
        if start is None:
            return None
        known = self._known_sides(view.pinhole, seen)
        state = np.array([start[0], start[1], self.person.height, self.person.radius])
        prior, weight = (
            state[2:].copy(),
            np.diag([0.0, 0.0, self.person.height_noise**-2, self.person.radius_noise**-2]),
        )
        for _ in range(_STEPS):
            sides, slope = self._linear(view, state)
            slope = slope[known]
            if not (np.isfinite(sides).all() and np.isfinite(slope).all()):
                return None
            information = slope.T @ slope / self.noise.pixel**2 + weight
            pull = slope.T @ (seen - sides)[known] / self.noise.pixel**2
            pull[2:] += weight[2:, 2:] @ (prior - state[2:])
            try:
                step = np.linalg.solve(information, pull)
            except np.linalg.LinAlgError:
                return None
            state = state + step
            state[2:] = np.maximum(state[2:], 0.05)
            if np.abs(step).max() < _SETTLED:
                break
        if not np.isfinite(state).all() or math.dist(state[:2], view.position[:2]) > self._farthest:
            return None
        return self._ground_point(view, state, known, weight)

    def foot(self, place: Array) -> Array:
        """Return the point on the ground, (3,) m, at horizontal coordinates (2,)."""
        x, y = float(place[0]), float(place[1])
        return np.array([x, y, self._ground(x, y)])

    def _hit(self, view: View, pixel: tuple[float, float], above: float) -> Array | None:
        """Return the point on a ray ``above`` m above the ground."""
        ray = view.rotation @ view.pinhole.rays(np.array([pixel], float))[0]
        ray /= np.linalg.norm(ray)
        if not -ray[2] >= math.sin(self._least_dip):
            return None
        place = view.position
        for _ in range(_STEPS):
            height = self._ground(float(place[0]), float(place[1])) + above
            length = (height - view.position[2]) / ray[2]
            if not 0.0 < length <= self._farthest:
                return None
            before, place = place, view.position + length * ray
            if np.abs(place - before).max() < _SETTLED:
                break
        return place

    def _known_sides(self, pinhole: Pinhole, box: Array) -> NDArray[np.bool_]:
        """Return which sides of a box are not cut off by the image."""
        limits = np.array([0.0, 0.0, pinhole.width, pinhole.height])
        known = np.abs(box - limits) > _EDGE
        # A person that fills the image leaves no usable side: use all, i.e. the centre of the image.
        return known if known.sum() >= 2 else np.ones(4, bool)

    def _linear(self, view: View, state: Array) -> tuple[Array, Array]:
        """Return the box of a cylinder, (4,) px, and its Jacobian, (4, 4); NaN as in :func:`cylinder_boxes`.

        Args:
            view: the camera.
            state: (4,) x, y of the foot, height, radius, m.
        """
        states = np.vstack([state, state + np.diag(_DELTA), state - np.diag(_DELTA)])
        feet = np.array([[x, y, self._ground(x, y)] for x, y in states[:, :2].tolist()])
        boxes = cylinder_boxes(view.pinhole, view.position, view.rotation, feet, states[:, 2], states[:, 3])
        return boxes[0], ((boxes[1:5] - boxes[5:]) / (2.0 * _DELTA[:, None])).T

    def _pose_slope(self, view: View, foot: Array, state: Array) -> Array:
        """Return the Jacobian of the box with respect to camera position and small rotations about map axes, (4, 6)."""
        steps = np.vstack([np.diag(_POSE_DELTA), -np.diag(_POSE_DELTA)])
        positions = view.position + steps[:, :3]
        rotations = np.array([rotation_from_vector(step[3:]) for step in steps]) @ view.rotation
        boxes = cylinder_boxes(view.pinhole, positions, rotations, foot, state[2], state[3])
        return ((boxes[:6] - boxes[6:]) / (2.0 * _POSE_DELTA[:, None])).T

    def _ground_point(self, view: View, state: Array, known: NDArray[np.bool_], weight: Array) -> GroundPoint | None:
        foot = self.foot(state[:2])
        slope, pose_slope = self._linear(view, state)[1][known], self._pose_slope(view, foot, state)[known]
        if not (np.isfinite(slope).all() and np.isfinite(pose_slope).all()):
            return None
        noise = self.noise
        covariance = np.linalg.inv(slope.T @ slope / noise.pixel**2 + weight)
        gain = covariance @ slope.T / noise.pixel**2
        pixels = gain @ gain.T * noise.pixel**2
        person = covariance @ weight @ covariance
        # Raising the ground has the same effect as lowering the camera.
        vertical = noise.vertical**2 + noise.ground**2
        position = _through(gain @ pose_slope[:, :3], np.diag([noise.horizontal**2, noise.horizontal**2, vertical]))
        attitude = _through(gain @ pose_slope[:, 3:], np.diag([noise.tilt**2, noise.tilt**2, noise.heading**2]))
        on_ground = self._on_ground(state)
        independent = _through(on_ground, (pixels + attitude)[:2, :2])
        shared = _through(on_ground, (person + position)[:2, :2]) + np.diag([0.0, 0.0, noise.ground**2])
        return GroundPoint(foot, independent, shared)

    def _on_ground(self, state: Array) -> Array:
        """Return the Jacobian of a point on the ground with respect to x and y, (3, 2)."""
        x, y = float(state[0]), float(state[1])
        delta = 0.1
        rise = [self._ground(x + dx, y + dy) - self._ground(x - dx, y - dy) for dx, dy in ((delta, 0.0), (0.0, delta))]
        return np.vstack([np.eye(2), np.array(rise) / (2.0 * delta)])


def cylinder_box(view: View, foot: Array, height: float, radius: float) -> Array:
    """Return the box of a standing cylinder: xmin, ymin, xmax, ymax, (4,) px, not clipped to the image.

    Args:
        view: the camera.
        foot: (3,) centre of its base, m, map.
        height, radius: m.

    Returns:
        NaN if any part of it is not in front of the camera.
    """
    return cylinder_boxes(view.pinhole, view.position, view.rotation, np.asarray(foot, float)[None], height, radius)[0]


def cylinder_boxes(
    pinhole: Pinhole, positions: Array, rotations: Array, feet: Array, heights: Array | float, radii: Array | float
) -> Array:
    """Return the boxes of n standing cylinders, (n, 4) px, as :func:`cylinder_box`; arguments are broadcast.

    Args:
        pinhole: intrinsics of all cameras.
        positions: (n, 3) or (3,) of the cameras, m, map.
        rotations: (n, 3, 3) or (3, 3) from the optical frame to map.
        feet: (n, 3) or (3,) m, map.
        heights, radii: (n,) or scalar, m.
    """
    camera = np.array([[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])
    projections = np.einsum("ij,...kj->...ik", camera, rotations)
    lower = np.einsum("...ij,...j->...i", projections, feet - positions)
    upper = lower + projections[..., 2] * np.asarray(heights)[..., None]
    rims = [_rim_boxes(projections, centres, np.asarray(radii, float)) for centres in (lower, upper)]
    return np.concatenate(
        [np.minimum(rims[0][..., :2], rims[1][..., :2]), np.maximum(rims[0][..., 2:], rims[1][..., 2:])], axis=-1
    )


def _rim_boxes(projections: Array, centres: Array, radii: Array) -> Array:
    """Return the boxes of horizontal circles, (n, 4) px.

    The image of a circle is a conic; a vertical line x = c is tangent to it if (1, 0, -c) D (1, 0, -c)' = 0 for its
    dual D.

    Args:
        projections: (n, 3, 3) from map to homogeneous pixels.
        centres: (n, 3) of the circles, homogeneous pixels.
        radii: (n,) m.
    """
    along = projections[..., :2]
    area = (radii * radii)[..., None]
    last = area[..., 0] * (along[..., 2, :] ** 2).sum(axis=-1) - centres[..., 2] ** 2
    mixed = area * (along[..., :2, :] * along[..., 2:, :]).sum(axis=-1) - centres[..., :2] * centres[..., 2:]
    squares = area * (along[..., :2, :] ** 2).sum(axis=-1) - centres[..., :2] ** 2
    last = np.where((centres[..., 2] > 0.0) & (last < 0.0), last, np.nan)[..., None]
    middles = mixed / last
    halves = np.sqrt(np.maximum(middles**2 - squares / last, 0.0))
    return np.concatenate([middles - halves, middles + halves], axis=-1)


def rotation_from_vector(angles: Array) -> Array:
    """Return the (3, 3) matrix of a rotation vector, rad (Rodrigues)."""
    angle = float(np.linalg.norm(angles))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = angles / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _through(matrix: Array, covariance: Array) -> Array:
    return matrix @ covariance @ matrix.T


def _flat(height: float) -> Ground:
    return lambda x, y: height
