"""Descriptions of robots on the ground and on water: ``config/robots/TYPE.yaml``, or a user's file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from xtdrone_control.autopilot.autopilot import STEP_US
from xtdrone_control.bounded_file import ContentError
from xtdrone_control.rotation import from_euler
from xtdrone_control.settings import SettingError, Settings, setting
from xtdrone_control.tag_boards import TagBoard, boards_of
from xtdrone_sim.descriptions import ModelError, available, read_description
from xtdrone_sim.robots import tag_visuals
from xtdrone_sim.robots.boat_dynamics import Boat, BoatLimits, HullSettings, check_step
from xtdrone_sim.robots.waves import WaveSettings
from xtdrone_sim.robots.wheel_drives import Ackermann, AckermannLimits, Differential, DifferentialLimits, Drive
from xtdrone_sim.robots.wheels_on_uneven_ground import Footprint, Ground
from xtdrone_sim.shapes.visual import Box, Collision, Cylinder, Pose, Visual
from xtdrone_sim.vehicles.urdf import Inertial
from xtdrone_sim.worlds.sdf import SdfLink, SdfModel

LINK = "base_link"
DRIVES = ("differential", "ackermann", "boat")

_FIELDS = ("drive", "limits", "body", "platform")
_BOAT_FIELDS = ("drive", "limits", "hull", "waves", "platform")
_LEAST_CLEARANCE = 0.05  # m: bodies do not touch the ground; Bullet does not simulate the wheels
_HEAVY = 1e5  # kg and kg m^2: so large that Bullet's solver moves the bodies that touch the robot, as its motors would
_TYRE = (0.08, 0.08, 0.08, 1.0)
_MARK = (0.8, 0.1, 0.1, 1.0)
_CASTORS = 0.4  # of the body's length, before and behind its middle
_PLATE = 0.04  # m, thickness of a platform


@dataclass(frozen=True)
class BodySettings(Settings):
    """Body of a robot, a box."""

    length: float = setting(1.2, low=0.05, high=20.0, unit="m", text="along its x")
    width: float = setting(0.8, low=0.05, high=20.0, unit="m", text="along its y")
    height: float = setting(0.35, low=0.02, high=10.0, unit="m", text="of its top above the ground")
    clearance: float = setting(0.1, low=_LEAST_CLEARANCE, high=5.0, unit="m", text="of its bottom above the ground")
    ahead: float = setting(0.0, low=-10.0, high=10.0, unit="m", text="distance of its middle ahead of the driven axle")
    colour: tuple[float, float, float] = setting((0.3, 0.3, 0.3), low=0.0, high=1.0, text="red, green, blue")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.height <= self.clearance:
            raise SettingError("height", self.height, f"above clearance, {self.clearance:g} m")


@dataclass(frozen=True)
class PlatformSettings(Settings):
    """Platform above a robot's body, on which vehicles land."""

    length: float = setting(1.4, low=0.1, high=50.0, unit="m", text="along its x")
    width: float = setting(1.4, low=0.1, high=50.0, unit="m", text="along its y")
    height: float = setting(0.5, low=0.1, high=20.0, unit="m", text="of its top above the ground")
    colour: tuple[float, float, float] = setting((0.85, 0.85, 0.8), low=0.0, high=1.0, text="red, green, blue")
    tags: str = setting(
        "",
        text="AprilTags on a white top instead of colour and cross: landing, or a YAML file, see docs/perception.md",
    )

    @property
    def board(self) -> TagBoard | None:
        """The tags on its top; None without.

        Raises:
            SettingError: ``tags`` is unknown, is more than one board, or does not fit.
        """
        if not self.tags:
            return None
        try:
            boards = boards_of(self.tags)
        except (OSError, ContentError) as error:
            raise SettingError("platform tags", self.tags, f"a readable file: {error}") from error
        if len(boards) != 1:
            raise SettingError("platform tags", self.tags, "one board or tag")
        return boards[0]


@dataclass(frozen=True)
class RobotModel:
    """A type of robot.

    Attributes:
        limits: wheels, and limits of the motion.
        body: its body.
        platform: its platform; None without one.
    """

    limits: DifferentialLimits | AckermannLimits
    body: BodySettings
    platform: PlatformSettings | None

    @property
    def ahead(self) -> float:
        """Distance of the platform's centre ahead of the origin, m."""
        return self.body.ahead

    def drive(self, pose: Pose, ground: Ground | None = None) -> Drive:
        """Return the drive at a pose, on ``ground`` if that is not level."""
        drive: Drive
        if isinstance(self.limits, AckermannLimits):
            drive = Ackermann(self.limits, pose)
        else:
            drive = Differential(self.limits, pose)
        if ground is not None:
            drive.stand_on(ground, self.feet)
        return drive

    @property
    def feet(self) -> Footprint:
        """Contact points with the ground: the wheels; of a robot with two of them, also castors in front and behind."""
        side = 0.5 * self.limits.track
        if isinstance(self.limits, AckermannLimits):
            return Footprint(0.0, self.limits.wheelbase, side)
        half = _CASTORS * self.body.length
        return Footprint(self.body.ahead - half, self.body.ahead + half, side)

    def model(self, name: str, pose: Pose, *, wheels: bool = True) -> SdfModel:
        """Return its model in the world: one link with body, platform and, if wanted, wheels."""
        body, deck = self.body, self.platform
        trunk = Box((body.length, body.width, round(body.height - body.clearance, 6)))
        place = Pose((body.ahead, 0.0, 0.5 * (body.height + body.clearance)))
        visuals, collisions = [Visual(trunk, place, (*body.colour, 1.0))], [Collision(trunk, place)]
        if deck is not None:
            plate = Box((deck.length, deck.width, _PLATE))
            top = Pose((body.ahead, 0.0, deck.height - 0.5 * _PLATE))
            collisions.append(Collision(plate, top))
            visuals += _deck(deck, body.ahead)
            post = deck.height - _PLATE - body.height
            if post > 0.0:
                visuals.append(Visual(Cylinder(0.06, post), Pose((body.ahead, 0.0, body.height + 0.5 * post)), _TYRE))
        inertial = Inertial(_HEAVY, Pose(), (_HEAVY, _HEAVY, _HEAVY, 0.0, 0.0, 0.0))
        link = SdfLink(
            LINK,
            visuals=(*visuals, *(self._wheels() if wheels else ())),
            collisions=tuple(collisions),
            inertial=inertial,
        )
        return SdfModel(name, pose, False, (link,))

    @property
    def wheels(self) -> list[tuple[str, float, float, bool]]:
        """Name, x and y, m, of each wheel, and whether it is steered."""
        half, limits = 0.5 * self.limits.track, self.limits
        if isinstance(limits, AckermannLimits):
            axles = [("rear_", 0.0, False), ("front_", limits.wheelbase, True)]
        else:
            axles = [("", 0.0, False)]
        return [
            (f"{axle}{side}", x, y, is_steered)
            for axle, x, is_steered in axles
            for side, y in (("right", -half), ("left", half))
        ]

    @property
    def wheel(self) -> Visual:
        """A wheel about its middle; its axis is y."""
        radius = self.limits.wheel_radius
        return Visual(
            Cylinder(radius, 0.35 * radius), Pose((0.0, 0.0, 0.0), from_euler(0.5 * math.pi, 0.0, 0.0)), _TYRE
        )

    def _wheels(self) -> list[Visual]:
        wheel, height = self.wheel, self.limits.wheel_radius
        return [
            Visual(wheel.geometry, Pose((x, y, height), wheel.pose.orientation), _TYRE) for _, x, y, _ in self.wheels
        ]


@dataclass(frozen=True)
class BoatModel:
    """A type of boat; its origin is the centre of the hull, at the waterline.

    Attributes:
        limits: thrusters and drag.
        hull: its hull.
        waves: of the water on which it floats.
        platform: its platform, whose height is measured from the waterline; None without one.
    """

    limits: BoatLimits
    hull: HullSettings
    waves: WaveSettings
    platform: PlatformSettings | None
    ahead = 0.0
    """Distance of the platform's centre ahead of the origin, m."""
    wheels: tuple[()] = ()

    def drive(self, pose: Pose, ground: Ground | None = None) -> Boat:
        """Return the boat at the position and heading of a pose, at rest; ``ground`` is not used."""
        return Boat(self.hull, self.limits, self.waves, pose)

    def model(self, name: str, pose: Pose, *, wheels: bool = True) -> SdfModel:
        """Return its model in the world: one link with hull, bow, thrusters and platform."""
        hull = self.hull
        trunk = Box((hull.length, hull.width, hull.depth))
        place = Pose((0.0, 0.0, 0.5 * hull.depth - hull.draught))
        paint = (*hull.colour, 1.0)
        visuals, collisions = [Visual(trunk, place, paint)], [Collision(trunk, place)]
        mark = Box((0.15 * hull.length, 0.35 * hull.width, 0.02))
        top = hull.depth - hull.draught
        visuals.append(Visual(mark, Pose((0.4 * hull.length, 0.0, top + 0.01)), _MARK))
        for side in (0.5, -0.5):
            pod = Pose((-0.5 * hull.length, side * self.limits.apart, 0.0))
            visuals.append(Visual(Box((0.08 * hull.length, 0.1 * hull.width, hull.depth)), pod, _TYRE))
        if self.platform is not None:
            plate = Box((self.platform.length, self.platform.width, _PLATE))
            collisions.append(Collision(plate, Pose((0.0, 0.0, self.platform.height - 0.5 * _PLATE))))
            visuals += _deck(self.platform, 0.0)
            post = self.platform.height - _PLATE - top
            if post > 0.0:
                visuals.append(Visual(Cylinder(0.08, post), Pose((0.0, 0.0, top + 0.5 * post)), _TYRE))
        inertial = Inertial(_HEAVY, Pose(), (_HEAVY, _HEAVY, _HEAVY, 0.0, 0.0, 0.0))
        link = SdfLink(LINK, visuals=tuple(visuals), collisions=tuple(collisions), inertial=inertial)
        return SdfModel(name, pose, False, (link,))


AnyRobot = RobotModel | BoatModel


def _deck(deck: PlatformSettings, ahead: float) -> list[Visual]:
    """Return the plate of a platform with its cross, or with its tags."""
    board = deck.board
    if board is not None:
        return tag_visuals.plate(board, deck.length, deck.width, _PLATE, Pose((ahead, 0.0, deck.height)))
    plate = Box((deck.length, deck.width, _PLATE))
    side = 0.35 * min(deck.length, deck.width)
    return [
        Visual(plate, Pose((ahead, 0.0, deck.height - 0.5 * _PLATE)), (*deck.colour, 1.0)),
        *(
            Visual(Box(size), Pose((ahead, 0.0, deck.height + 0.001)), _MARK)
            for size in ((side, 0.15 * side, 0.004), (0.15 * side, side, 0.004))
        ),
    ]


def robot_types() -> list[str]:
    """Return the names of the package's robots."""
    return available("robots")


def load_robot(name: str) -> AnyRobot:
    """Return a type of robot.

    Args:
        name: one of ``robot_types``, or a path ending in .yaml or .yml.

    Raises:
        ModelError: an unknown type, or an invalid file; the message names file, field, value and what is allowed.
    """
    if not name.endswith((".yaml", ".yml")) and name not in robot_types():
        raise ModelError(
            f"robots: type {name[:60]!r} is not known; there are {', '.join(robot_types())}, or a YAML file"
        )
    given = read_description("robots", str(Path(name).expanduser()) if name.endswith((".yaml", ".yml")) else name)
    known = _BOAT_FIELDS if given.get("drive") == "boat" else _FIELDS
    for field in given:
        if field not in known:
            raise ModelError(f"robot {name}: field {str(field)[:60]!r} is not known; there are {', '.join(known)}")
    try:
        return _checked_boat(given) if given.get("drive") == "boat" else _checked(given)
    except SettingError as error:
        raise ModelError(f"robot {name}: {error}") from error


def _checked_boat(given: Mapping[str, object]) -> BoatModel:
    limits = BoatLimits.from_mapping(given.get("limits", {}), "limits")
    hull = HullSettings.from_mapping(given.get("hull", {}), "hull")
    waves = WaveSettings.from_mapping(given.get("waves", {}), "waves")
    check_step(hull, limits, STEP_US * 1e-6)
    deck = given.get("platform")
    platform = None if deck is None else PlatformSettings.from_mapping(deck, "platform")
    top = hull.depth - hull.draught + _PLATE
    if platform is not None and platform.height < top:
        raise SettingError("platform height", platform.height, f"at least hull and plate, {top:g} m above the water")
    if platform is not None:
        _deck(platform, 0.0)
    return BoatModel(limits, hull, waves, platform)


def _checked(given: Mapping[str, object]) -> RobotModel:
    kind = given.get("drive")
    if kind not in DRIVES:
        raise SettingError("drive", kind, f"{', '.join(DRIVES[:-1])} or {DRIVES[-1]}")
    settings = AckermannLimits if kind == "ackermann" else DifferentialLimits
    limits = settings.from_mapping(given.get("limits", {}), "limits")
    body = BodySettings.from_mapping(given.get("body", {}), "body")
    deck = given.get("platform")
    platform = None if deck is None else PlatformSettings.from_mapping(deck, "platform")
    if platform is not None and platform.height < body.height + _PLATE:
        raise SettingError("platform height", platform.height, f"at least body and plate, {body.height + _PLATE:g} m")
    if platform is not None:
        _deck(platform, body.ahead)  # its tags are known and fit
    assert isinstance(limits, DifferentialLimits | AckermannLimits)
    return RobotModel(limits, body, platform)
