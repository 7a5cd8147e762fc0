"""Cameras, gimbals and landing gear that a vehicle's YAML mounts on the links and joints of its URDF."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from xtdrone_common.cameras import Equidistant, Lens, PlumbBob, drawing_of
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose, compose
from xtdrone_common.rotation import Quaternion, Vector, from_euler, multiply
from xtdrone_common.settings import check_choice, check_range
from xtdrone_worlds.worlds.urdf import FIXED, Description, Joint, UrdfError

_CAMERA = {"name", "link", "width", "height", "hfov", "rate", "near", "far", "frame_id", "kind", "position", "rpy"}
_PICTURE = {"image_noise", "seed", "distortion", "distortion_model", "exposure", "exposure_pictures"}
_DEPTH = {"range_min", "range_max", "noise", "encoding", "seed"}
_STEREO = {"baseline"}
KINDS = ("rgb", "depth", "rgbd", "stereo")
ENCODINGS = ("32FC1", "16UC1")
_LENSES: dict[str, type[PlumbBob] | type[Equidistant]] = {kind.model: kind for kind in (PlumbBob, Equidistant)}
_LONGEST = 0.5  # s, exposure
_MOST_PICTURES = 63  # of an exposure
_GIMBAL = {"yaw", "roll", "pitch", "rate"}
_AXES: dict[str, Vector] = {"yaw": (0.0, 0.0, 1.0), "roll": (1.0, 0.0, 0.0), "pitch": (0.0, 1.0, 0.0)}
_ALIGNED = 1e-6
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


class MountError(ValueError):
    """An invalid camera, gimbal or landing gear; the message names field, value and what is allowed."""


def check_sensor_name(name: str) -> None:
    """Check the name of a sensor, which is part of its topic.

    Raises:
        ValueError: the name is not allowed; the message says which names are.
    """
    if not _NAME.fullmatch(name):
        raise ValueError("letters, digits and underscores, in parts separated by slashes, each beginning with a letter")


@dataclass(frozen=True)
class CameraMount:
    """A camera on a link of a vehicle.

    Attributes:
        name: name in the topics, which ``cameras.camera_messages`` lists for each kind.
        link: link of the URDF.
        pinhole: projection.
        rate: image rate in simulated time, Hz.
        near, far: limits of the visible range, m.
        frame_id: optical frame (x right, y down, z ahead), to be prefixed with ``VEHICLE/``; of a stereo pair, that of
            the left camera.
        kind: one of ``KINDS``.
        pose: pose in the link; the camera looks along x, with z up in the image.
        baseline: baseline of a stereo pair, m; the left camera is at +y, the right one at -y.
        range_min, range_max: depths outside are not measured, m.
        noise: standard deviation of a depth over its square, 1/m: that of stereo and structured light.
        encoding: encoding of depth images, one of ``ENCODINGS``: m, or mm as whole numbers.
        seed: seed of the noises, together with vehicle and name.
        image_noise: standard deviation of each channel of colour images, in parts of full scale, as in Gazebo.
        lens: distortion of colour images; None: a pinhole.
        exposure: time for which the shutter is open, s; 0: an instant.
        exposure_pictures: odd number of instants whose mean is the image of an exposure longer than 0.
    """

    name: str
    link: str
    pinhole: Pinhole
    rate: float
    near: float
    far: float
    frame_id: str
    kind: str = "rgb"
    pose: Pose = field(default_factory=Pose)
    baseline: float = 0.0
    range_min: float = 0.0
    range_max: float = math.inf
    noise: float = 0.0
    encoding: str = "32FC1"
    seed: int = 0
    image_noise: float = 0.0
    lens: Lens | None = None
    exposure: float = 0.0
    exposure_pictures: int = 9

    @property
    def has_depth(self) -> bool:
        """Whether it measures depths."""
        return self.kind in ("depth", "rgbd")

    @property
    def eyes(self) -> tuple[tuple[str, Pose], ...]:
        """Optical frame and pose in the link of each of its cameras, the left one first."""
        if self.kind != "stereo":
            return ((self.frame_id, self.pose),)
        half = 0.5 * self.baseline
        right = f"{self.name.replace('/', '_')}_right_optical_frame"
        return tuple(
            (frame, compose(self.pose, Pose((0.0, side, 0.0))))
            for frame, side in ((self.frame_id, half), (right, -half))
        )


@dataclass(frozen=True)
class GimbalMount:
    """A gimbal: a chain of three joints that turn about z, x and y.

    Attributes:
        joints: joints of yaw, roll and pitch, from the body outwards.
        signs: 1, or -1 for a joint with the opposite axis, in the same order.
        rate: maximum rate of change of the commanded direction, rad/s.
    """

    joints: tuple[Joint, Joint, Joint]
    signs: tuple[float, float, float]
    rate: float

    @property
    def link(self) -> str:
        """Link held by the gimbal: the child of the last joint."""
        return self.joints[2].child


def read_cameras(cameras: Any, urdf: Description) -> tuple[CameraMount, ...]:
    """Return the cameras of the YAML list ``cameras:``.

    Args:
        cameras: content of the list; None for no cameras.
        urdf: the vehicle's links.

    Raises:
        MountError: missing, unknown or invalid field, unknown link, or duplicate name.
    """
    if not isinstance(cameras or [], list):
        raise MountError(f"cameras: {cameras!r} is not allowed, a list")
    mounts = tuple(_camera(entry, f"cameras, number {i}", urdf) for i, entry in enumerate(cameras or [], start=1))
    names = [mount.name for mount in mounts]
    for name in names:
        if names.count(name) > 1:
            raise MountError(f"cameras: name {name!r} is given {names.count(name)} times")
    return mounts


def _camera(entry: Any, where: str, urdf: Description) -> CameraMount:
    kind = entry.get("kind", "rgb") if isinstance(entry, Mapping) else "rgb"
    own = {"stereo": _STEREO | _PICTURE, "depth": _DEPTH, "rgbd": _DEPTH | _PICTURE, "rgb": _PICTURE}
    fields = own.get(str(kind), set())
    _check_fields(entry, _CAMERA | fields, {"name", "link", "width", "height", "hfov"} | (fields & _STEREO), where)
    name, link = str(entry["name"]), str(entry["link"])
    try:
        check_choice("kind", kind, KINDS)
        if _NAME.fullmatch(name) is None:
            raise ValueError(
                f"name: {name[:80]!r} is not allowed, letters, digits and _, in parts separated by slashes"
            )
        lens, pinhole = _lens(entry) if fields >= _PICTURE else (None, _pinhole(entry))
        near = check_range("near", entry.get("near", 0.05), 1e-3, 10.0, "m")
        far = check_range("far", entry.get("far", 500.0), near, 1e5, "m")
        rate = check_range("rate", entry.get("rate", 10.0), 0.1, 50.0, "Hz")
        urdf.link(link)
        pose, special = _pose(entry), _special(entry, kind) | _picture(entry)
    except ValueError as error:
        raise MountError(f"{where} ({name}): {error}") from error
    side = "_left" if kind == "stereo" else ""
    frame = str(entry.get("frame_id", f"{name.replace('/', '_')}{side}_optical_frame"))
    return CameraMount(name, link, pinhole, rate, near, far, frame, kind, pose, lens=lens, **special)


def _pose(entry: Mapping[str, Any]) -> Pose:
    parts = []
    for name, most, unit in (("position", 10.0, "m"), ("rpy", 2.0 * math.pi, "rad")):
        values = entry.get(name, [0.0, 0.0, 0.0])
        if not isinstance(values, list) or len(values) != 3:
            raise ValueError(f"{name}: {str(values)[:80]} is not allowed, a list of 3 numbers")
        parts.append([check_range(name, value, -most, most, unit) for value in values])
    (x, y, z), (roll, pitch, yaw) = parts
    return Pose((x, y, z), from_euler(roll, pitch, yaw))


def _special(entry: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Return the fields of depth cameras and stereo pairs."""
    if kind == "stereo":
        return {"baseline": check_range("baseline", entry["baseline"], 1e-3, 10.0, "m")}
    if kind == "rgb":
        return {}
    least = check_range("range_min", entry.get("range_min", 0.2), 0.0, 1000.0, "m")
    return {
        "range_min": least,
        "range_max": check_range("range_max", entry.get("range_max", 10.0), least, 1000.0, "m"),
        "noise": check_range("noise", entry.get("noise", 0.0), 0.0, 1.0, "1/m"),
        "encoding": check_choice("encoding", entry.get("encoding", ENCODINGS[0]), ENCODINGS),
    }


def _picture(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the noise of a camera's images, the seed, and the exposure."""
    count = entry.get("exposure_pictures", 9)
    if int(check_range("exposure_pictures", count, 1, _MOST_PICTURES)) != count or count % 2 != 1:
        raise ValueError(f"exposure_pictures: {count} is not allowed, an odd number from 1 to {_MOST_PICTURES}")
    return {
        "exposure": check_range("exposure", entry.get("exposure", 0.0), 0.0, _LONGEST, "s"),
        "exposure_pictures": int(count),
        "seed": int(check_range("seed", entry.get("seed", 0), 0, 2**31 - 1)),
        "image_noise": check_range("image_noise", entry.get("image_noise", 0.0), 0.0, 1.0),
    }


def _pinhole(entry: Mapping[str, Any]) -> Pinhole:
    return Pinhole.of_view(entry["width"], entry["height"], entry["hfov"])


def _lens(entry: Mapping[str, Any]) -> tuple[Lens | None, Pinhole]:
    """Return the lens of a camera's images, if there is one, and the pinhole without its distortion."""
    values = entry.get("distortion")
    model = check_choice("distortion_model", entry.get("distortion_model", PlumbBob.model), tuple(_LENSES))
    names = _LENSES[model].names
    if values is None:
        if "distortion_model" in entry:
            raise ValueError(f"distortion: it must be given with distortion_model, {_coefficients(names)}")
        return None, _pinhole(entry)
    if not isinstance(values, list) or len(values) != len(names):
        raise ValueError(f"distortion: {str(values)[:80]} is not allowed, {_coefficients(names)}")
    numbers = tuple(check_range("distortion", value, -10.0, 10.0) for value in values)
    lens: Lens
    if model == Equidistant.model:
        lens = Equidistant.of_view(entry["width"], entry["height"], entry["hfov"], numbers)
    else:
        lens = PlumbBob(_pinhole(entry), numbers)
    drawing_of(lens)
    return lens, lens.pinhole


def _coefficients(names: Sequence[str]) -> str:
    return f"a list of {len(names)} numbers: {', '.join(names)}"


def read_gimbal(gimbal: Any, urdf: Description) -> GimbalMount | None:
    """Return the gimbal of the YAML section ``gimbal:``.

    Args:
        gimbal: content of the section; None for no gimbal.
        urdf: the vehicle's joints.

    Raises:
        MountError: missing, unknown or invalid field, unknown joint, joint with another axis, or joints that do not
            form a chain.
    """
    if gimbal is None:
        return None
    _check_fields(gimbal, _GIMBAL, {"yaw", "roll", "pitch"}, "gimbal")
    try:
        rate = check_range("gimbal: rate", gimbal.get("rate", math.pi / 2), 0.01, 100.0, "rad/s")
        yaw, roll, pitch = (urdf.joint(str(gimbal[name])) for name in _AXES)
    except UrdfError as error:
        raise MountError(f"gimbal: {error}") from error
    except ValueError as error:
        raise MountError(str(error)) from error
    signs = tuple(_sign(joint, name, urdf) for joint, name in ((yaw, "yaw"), (roll, "roll"), (pitch, "pitch")))
    for outer, inner in ((yaw, roll), (roll, pitch)):
        if urdf.carrier(inner.parent)[0] != outer.child:
            raise MountError(
                f"gimbal: joint {inner.name!r} is not allowed on link {inner.parent!r}, on {outer.child!r}"
            )
    return GimbalMount((yaw, roll, pitch), (signs[0], signs[1], signs[2]), rate)


def read_landing_gear(joints: Any, urdf: Description) -> tuple[Joint, ...]:
    """Return the joints of the YAML list ``landing_gear:``.

    At 0 the vehicle stands on them; at their upper limits they are out of the camera's view.

    Args:
        joints: names of the joints; None for fixed landing gear.
        urdf: the vehicle's joints.

    Raises:
        MountError: not a list, unknown joint, or joint without limits of position and speed.
    """
    if not isinstance(joints or [], list):
        raise MountError(f"landing_gear: {joints!r} is not allowed, a list of joints")
    found = []
    for name in joints or []:
        try:
            joint = urdf.joint(str(name))
        except UrdfError as error:
            raise MountError(f"landing_gear: {error}") from error
        if joint.kind != "revolute" or not (0.0 < joint.upper < math.inf and 0.0 < joint.velocity < math.inf):
            raise MountError(
                f"landing_gear: joint {joint.name!r} of type {joint.kind}, upper {joint.upper:g}, velocity "
                f"{joint.velocity:g} is not allowed, revolute with limits above 0"
            )
        found.append(joint)
    return tuple(found)


def _sign(joint: Joint, name: str, urdf: Description) -> float:
    """Return the sign of a gimbal joint's axis: 1 or -1."""
    if joint.kind == FIXED:
        raise MountError(f"gimbal: {name} joint {joint.name!r} of type fixed is not allowed, revolute or continuous")
    rest = _rest_turn(joint, urdf)
    if max(abs(part) for part in rest[1:]) > _ALIGNED:
        raise MountError(f"gimbal: {name} joint {joint.name!r}: rpy is not allowed in its origin, or below it: 0 0 0")
    along = sum(a * b for a, b in zip(joint.axis, _AXES[name], strict=True))
    if abs(abs(along) - 1.0) > _ALIGNED:
        axis = " ".join(f"{part:g}" for part in joint.axis)
        wanted = " ".join(f"{part:g}" for part in _AXES[name])
        raise MountError(f"gimbal: {name} joint {joint.name!r}: axis {axis} is not allowed, {wanted} or its opposite")
    return 1.0 if along > 0.0 else -1.0


def _rest_turn(joint: Joint, urdf: Description) -> Quaternion:
    """Return the orientation of a joint's frame, at 0, in the moving link that carries it, (w, x, y, z)."""
    _, pose = urdf.carrier(joint.parent)
    return multiply(pose.orientation, joint.pose.orientation)


def _check_fields(entry: Any, known: set[str], needed: set[str], where: str) -> None:
    if not isinstance(entry, Mapping):
        raise MountError(f"{where}: {entry!r} is not allowed, a mapping")
    for name in entry:
        if name not in known:
            raise MountError(f"{where}: field {name!r} is not known; there are {', '.join(sorted(known))}")
    for name in sorted(needed - set(entry)):
        raise MountError(f"{where}: field {name!r} is missing")
