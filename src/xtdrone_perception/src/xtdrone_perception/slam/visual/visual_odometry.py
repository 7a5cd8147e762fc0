"""Visual odometry: track corners with depth, estimate each image's pose from their points, adjust keyframes.

Each image's pose is estimated from the points that it sees (``pose_from_points``). From time to time an image becomes a
keyframe: the last few keyframes and their points are adjusted together (``window_adjustment``), and new corners are
added where there are none.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import angle_between, distance_between
from xtdrone_common.settings import Settings, setting
from xtdrone_perception.slam.odometry_health import Estimate, weakest_share, without_registration

from .camera_model import BodyCamera
from .corner_tracks import Grey, TrackSettings, depth_at, new_corners, stereo_depth, track
from .pose_from_points import NoiseSettings, Sigmas, Solved, solve
from .window_adjustment import WindowProblem, adjust

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

_MISSES = 2  # images without a pose after which odometry restarts at the predicted pose


@dataclass(frozen=True)
class KeyframeSettings(Settings):
    """Private parameters of the keyframes."""

    keyframes: int = setting(6, low=2, high=20, text="number of keyframes adjusted together")
    keyframe_share: float = setting(
        0.7, low=0.0, high=1.0, text="fraction of the last keyframe's points below which an image becomes a keyframe"
    )
    keyframe_step: float = setting(
        0.4, above=0.0, high=100.0, unit="m", text="distance after which an image becomes one"
    )
    keyframe_turn: float = setting(
        0.2, above=0.0, high=3.2, unit="rad", text="rotation after which an image becomes one"
    )
    depth_min: float = setting(0.3, low=0.05, high=100.0, unit="m", text="closer points are ignored")
    depth_max: float = setting(25.0, low=0.5, high=1000.0, unit="m", text="farther points are ignored")
    least_points: int = setting(20, low=6, high=1000, text="minimum number of points in an image")


@dataclass(frozen=True)
class SeenPicture:
    """An image with depth information: a depth image, or the right image of a stereo pair.

    Attributes:
        grey: (height, width).
        depth: (height, width) m, registered to ``grey``; NaN where unknown.
        right: (height, width), rectified.
        base: focal length times baseline, px m.
        attitude: Attitude of the autopilot at the exposure, body to its map.
        time: Time of the exposure, s.
    """

    grey: Grey
    attitude: Rotation
    time: float
    depth: NDArray[np.float32] | None = None
    right: Grey | None = None
    base: float = 0.0


@dataclass(frozen=True)
class Tracks:
    """Tracked corners.

    Attributes:
        ids: (n,) unique, ascending.
        measured: (n, 5) u, v (px), inverse depth (1/m, NaN where unknown), its slopes along u and v (1/m/px), in the
            last image.
        points: (n, 3) m, map.
    """

    ids: Ids = field(default_factory=lambda: np.empty(0, np.int64))
    measured: Array = field(default_factory=lambda: np.empty((0, 5)))
    points: Array = field(default_factory=lambda: np.empty((0, 3)))

    def of(self, chosen: NDArray[np.bool_]) -> Tracks:
        """Return some of them; chosen: (n,) bool."""
        return Tracks(self.ids[chosen], self.measured[chosen], self.points[chosen])

    def joined(self, other: Tracks) -> Tracks:
        """Return these and others, whose ids are greater."""
        return Tracks(
            np.concatenate([self.ids, other.ids]),
            np.concatenate([self.measured, other.measured]),
            np.concatenate([self.points, other.points]),
        )


@dataclass(frozen=True, kw_only=True)
class VisualEstimate(Estimate):
    """Result of one image; its tracks are the inliers."""

    picture: SeenPicture
    tracks: Tracks


@dataclass
class _Keyframe:
    """An image of the window: pose (4, 4), time (s), the autopilot's attitude, and what was seen of which corners."""

    pose: Array
    time: float
    attitude: Rotation
    ids: Ids
    measured: Array


class VisualOdometry:
    """The window of keyframes and the vehicle's pose.

    Attributes:
        pose: (4, 4) body to map, at the last image.
    """

    def __init__(
        self,
        camera: BodyCamera,
        settings: tuple[TrackSettings, NoiseSettings, KeyframeSettings],
        base: float,
        start: Array,
    ) -> None:
        """Begin without points.

        Args:
            camera: that takes the images (the left one of a pair).
            settings: Settings of corners, errors and keyframes.
            base: focal length times baseline of a stereo pair, px m; 0: a depth camera.
            start: (4, 4) pose of the body in the map.
        """
        self._camera = camera
        self._corners, self._noise, self._settings = settings
        deep = self._noise.disparity_noise / base if base > 0.0 else self._noise.depth_noise
        pixel = self._noise.pixel_noise
        self._deviations = np.array([pixel, pixel, deep])
        self.pose = start
        self._forget()

    def _forget(self) -> None:
        self._grey: Grey | None = None
        self._time = 0.0
        self._tracks = Tracks()
        self._window: list[_Keyframe] = []
        self._points: dict[int, Array] = {}
        self._next_id = 0
        self._misses = 0

    def register(self, picture: SeenPicture, predicted: Array) -> VisualEstimate:
        """Return the pose of an image; keyframes and ``pose`` do not change, unless odometry restarts.

        Args:
            picture: the new one.
            predicted: (4, 4) pose of the body.
        """
        if self._misses > _MISSES:
            self._forget()
        if self._grey is None:
            corners = self._new_tracks(picture, predicted, Tracks())
            return self._without_pose(picture, predicted, corners, is_first=True)
        seen = self._follow(self._grey, self._tracks, picture, predicted)
        if len(seen.ids) < self._settings.least_points:
            return self._without_pose(picture, predicted, seen)
        most = self._noise.most_reprojection
        sigmas = Sigmas(self._deviations, self._noise.turn_error(picture.time - self._time))
        solved = solve(self._camera, sigmas, most, predicted, seen.points, seen.measured)
        if solved is None:
            return self._without_pose(picture, predicted, seen)
        return VisualEstimate(
            pose=solved.pose,
            predicted=predicted,
            count=len(seen.ids),
            share=float(solved.inliers.mean()),
            residual=solved.residual,
            weakest=weakest_share(solved.information[:3, :3]),
            covariance=_covariance(solved),
            picture=picture,
            tracks=seen.of(solved.inliers),
        )

    def accept(self, found: VisualEstimate) -> None:
        """Move to the pose of an image, and make it a keyframe if it shows enough that is new."""
        self.pose, self._time, self._misses = found.pose, found.picture.time, 0
        if self._is_keyframe(found):
            self._tracks, self._grey = found.tracks, found.picture.grey
            self._add_keyframe(found.picture)

    def move(self, pose: Array) -> None:
        """Move to a predicted pose, without an image."""
        self.pose = pose
        self._misses += 1

    # tracks

    def _follow(self, before: Grey, tracks: Tracks, picture: SeenPicture, predicted: Array) -> Tracks:
        """Return the tracks of an earlier image in a new one."""
        guess = self._camera.measure(predicted, tracks.points)[0]
        pixels, good = track(self._corners, before, picture.grey, tracks.measured[:, :2], guess[:, :2])
        seen = tracks.of(good)
        depth, slopes = self._depths(picture, pixels[good], 1.0 / guess[good, 2])
        return Tracks(seen.ids, np.column_stack([pixels[good], 1.0 / depth, slopes]), seen.points)

    def _depths(self, picture: SeenPicture, pixels: Array, guess: Array) -> tuple[Array, Array]:
        """Return depths (n,) m, NaN where unknown or out of range, and slopes (n, 2) of their inverse, 1/m/px.

        The disparity of a pair is measured for a patch, and its slope is not known: 0.

        Args:
            picture: Image with a depth image, or a stereo pair.
            pixels: (n, 2) px.
            guess: (n,) m, NaN where unknown.
        """
        slopes = np.zeros((len(pixels), 2))
        if picture.right is not None:
            found = stereo_depth(self._corners, picture.grey, picture.right, pixels, picture.base, guess)
        elif picture.depth is not None:
            found, slopes = depth_at(picture.depth, pixels)
        else:
            found = np.full(len(pixels), np.nan)
        usable = (found >= self._settings.depth_min) & (found <= self._settings.depth_max)
        return np.where(usable, found, np.nan), slopes

    def _new_tracks(self, picture: SeenPicture, pose: Array, known: Tracks) -> Tracks:
        """Return new corners with a depth, in an image at a pose."""
        usable = None if picture.depth is None else np.isfinite(picture.depth) & (picture.depth > 0.0)
        pixels = new_corners(self._corners, picture.grey, known.measured[:, :2], usable)
        depth, slopes = self._depths(picture, pixels, np.full(len(pixels), np.nan))
        deep = np.isfinite(depth)
        pixels, depth, slopes = pixels[deep], depth[deep], slopes[deep]
        ids = self._next_id + np.arange(len(pixels), dtype=np.int64)
        measured = np.column_stack([pixels, 1.0 / depth, slopes])
        return Tracks(ids, measured, self._camera.points(pose, pixels, depth))

    def _without_pose(
        self, picture: SeenPicture, predicted: Array, seen: Tracks, is_first: bool = False
    ) -> VisualEstimate:
        figures = without_registration(predicted, len(seen.ids), is_first)
        return VisualEstimate(**figures, picture=picture, tracks=Tracks() if is_first else seen)

    # keyframes

    def _is_keyframe(self, found: VisualEstimate) -> bool:
        if not self._window:
            return True
        last, settings = self._window[-1], self._settings
        seen = np.isin(last.ids, found.tracks.ids, assume_unique=True).sum()
        return bool(
            seen < settings.keyframe_share * len(last.ids)
            or distance_between(last.pose, found.pose) > settings.keyframe_step
            or angle_between(last.pose, found.pose) > settings.keyframe_turn
        )

    def _add_keyframe(self, picture: SeenPicture) -> None:
        known = self._tracks
        self._window.append(_Keyframe(self.pose, picture.time, picture.attitude, known.ids, known.measured))
        if len(self._window) > 1:
            self._adjust()
        known = Tracks(
            known.ids, known.measured, np.array([self._points[k] for k in known.ids.tolist()]).reshape(-1, 3)
        )
        new = self._new_tracks(picture, self.pose, known)
        self._next_id += len(new.ids)
        self._points.update(zip(new.ids.tolist(), new.points, strict=True))
        self._tracks = known.joined(new)
        self._window[-1] = replace(
            self._window[-1], pose=self.pose, ids=self._tracks.ids, measured=self._tracks.measured
        )
        del self._window[: -self._settings.keyframes]
        alive = np.unique(np.concatenate([frame.ids for frame in self._window])).tolist()
        self._points = {k: self._points[k] for k in alive}

    def _adjust(self) -> None:
        """Adjust the window's poses and points."""
        window = self._window
        ids, point = np.unique(np.concatenate([frame.ids for frame in window]), return_inverse=True)
        frame = np.repeat(np.arange(len(window)), [len(entry.ids) for entry in window])
        measured = np.concatenate([entry.measured for entry in window])
        often = np.bincount(point)[point] > 1
        used, point = np.unique(point[often], return_inverse=True)
        if len(used) < self._settings.least_points:
            return
        turns = tuple(a.attitude.inv() * b.attitude for a, b in itertools.pairwise(window))
        errors = np.array([self._noise.turn_error(b.time - a.time) for a, b in itertools.pairwise(window)])
        problem = WindowProblem(turns, errors, frame[often], point, measured[often])
        keys = ids[used].tolist()
        poses = np.stack([entry.pose for entry in window])
        points = np.array([self._points[key] for key in keys])
        poses, points = adjust(self._camera, self._deviations, problem, poses, points)
        for entry, pose in zip(window, poses, strict=True):
            entry.pose = pose
        self._points.update(zip(keys, points, strict=True))
        self.pose = poses[-1]


def _covariance(solved: Solved) -> Array:
    """Return the covariance of x, y, z (map) and rotation (body) of a pose among the window's points."""
    found = np.linalg.pinv(solved.information, hermitian=True) * max(solved.residual, 0.1) ** 2
    covariance: Array = 0.5 * (found + found.T)
    return covariance
