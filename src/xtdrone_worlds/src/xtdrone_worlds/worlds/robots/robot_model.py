"""Descriptions of robots on the ground and on water: ``config/robots/TYPE.yaml``, or a user's file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from xtdrone_common.files import ContentError
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_common.tag_boards import TagBoard, boards_of
from xtdrone_worlds.descriptions import ModelError, available, read_description
from xtdrone_worlds.shapes.visual import Box, Collision, Cylinder, Visual
from xtdrone_worlds.worlds.robots import tag_visuals
from xtdrone_worlds.worlds.robots.robot_settings import (
    STEP,
    AckermannLimits,
    BoatLimits,
    DifferentialLimits,
    HullSettings,
    WaveSettings,
    check_step,
)
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel
from xtdrone_worlds.worlds.urdf import Inertial

LINK = "base_link"
DRIVES = ("differential", "ackermann", "boat")

_FIELDS = ("drive", "limits", "body", "platform")
_BOAT_FIELDS = ("drive", "limits", "hull", "waves", "platform")
_LEAST_CLEARANCE = 0.05  # m: bodies do not touch the ground; Bullet does not simulate the wheels
_HEAVY = 1e5  # kg and kg m^2: so large that Bullet's solver moves the bodies that touch the robot, as its motors would
_TYRE = (0.08, 0.08, 0.08, 1.0)
_MARK = (0.8, 0.1, 0.1, 1.0)
_PLATE = 0.04  # m, thickness of a platform


@dataclass(frozen=True)
class BodySettings(Settings):
    """Body of a robot, a box."""

    length: float = setting(1.2, low=0.05, high=20.0, unit="m", text="length along x")
    width: float = setting(0.8, low=0.05, high=20.0, unit="m", text="width along y")
    height: float = setting(0.35, low=0.02, high=10.0, unit="m", text="height of the top above the ground")
    clearance: float = setting(
        0.1, low=_LEAST_CLEARANCE, high=5.0, unit="m", text="height of the bottom above the ground"
    )
    ahead: float = setting(0.0, low=-10.0, high=10.0, unit="m", text="distance of the middle ahead of the driven axle")
    colour: tuple[float, float, float] = setting((0.3, 0.3, 0.3), low=0.0, high=1.0, text="red, green, blue")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.height <= self.clearance:
            raise SettingError("height", self.height, f"above clearance, {self.clearance:g} m")


@dataclass(frozen=True)
class PlatformSettings(Settings):
    """Platform above a robot's body, on which vehicles land."""

    length: float = setting(1.4, low=0.1, high=50.0, unit="m", text="length along x")
    width: float = setting(1.4, low=0.1, high=50.0, unit="m", text="width along y")
    height: float = setting(0.5, low=0.1, high=20.0, unit="m", text="height of the top above the ground")
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

    def model(self, name: str, pose: Pose, *, wheels: bool = True) -> SdfModel:
        """Return its model in the world: one link with body, platform and, if wanted, wheels."""
        body = self.body
        trunk = Box((body.length, body.width, round(body.height - body.clearance, 6)))
        place = Pose((body.ahead, 0.0, 0.5 * (body.height + body.clearance)))
        visuals, collisions = [Visual(trunk, place, (*body.colour, 1.0))], [Collision(trunk, place)]
        _add_platform(self.platform, self.ahead, body.height, 0.06, visuals, collisions)
        return _model(name, pose, [*visuals, *(self._wheels() if wheels else ())], collisions)

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
        waves: waves of the water on which it floats.
        platform: its platform, whose height is measured from the waterline; None without one.
    """

    limits: BoatLimits
    hull: HullSettings
    waves: WaveSettings
    platform: PlatformSettings | None
    ahead = 0.0
    """Distance of the platform's centre ahead of the origin, m."""
    wheels: tuple[()] = ()

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
        _add_platform(self.platform, self.ahead, top, 0.08, visuals, collisions)
        return _model(name, pose, visuals, collisions)


AnyRobot = RobotModel | BoatModel


def _model(name: str, pose: Pose, visuals: list[Visual], collisions: list[Collision]) -> SdfModel:
    """Return a robot's model, one link."""
    inertial = Inertial(_HEAVY, Pose(), (_HEAVY, _HEAVY, _HEAVY, 0.0, 0.0, 0.0))
    link = SdfLink(LINK, visuals=tuple(visuals), collisions=tuple(collisions), inertial=inertial)
    return SdfModel(name, pose, False, (link,))


def _add_platform(
    deck: PlatformSettings | None,
    ahead: float,
    top: float,
    radius: float,
    visuals: list[Visual],
    collisions: list[Collision],
) -> None:
    """Add a platform and the post that carries it.

    Args:
        deck: the platform; None: nothing is added.
        ahead: distance of its centre ahead of the origin, m.
        top: height of the robot's body, m.
        radius: radius of the post, m.
        visuals, collisions: shapes of the robot, appended to.
    """
    if deck is None:
        return
    collisions.append(Collision(Box((deck.length, deck.width, _PLATE)), Pose((ahead, 0.0, deck.height - 0.5 * _PLATE))))
    visuals += _deck(deck, ahead)
    post = deck.height - _PLATE - top
    if post > 0.0:
        visuals.append(Visual(Cylinder(radius, post), Pose((ahead, 0.0, top + 0.5 * post)), _TYRE))


def _read_platform(given: Mapping[str, object], ahead: float, top: float, below: str) -> PlatformSettings | None:
    """Return the platform of a description; None without one.

    Raises:
        SettingError: it is not above ``top``, m, with its plate, or its tags are unknown or do not fit.
    """
    deck = given.get("platform")
    if deck is None:
        return None
    platform = PlatformSettings.from_mapping(deck, "platform")
    if platform.height < top + _PLATE:
        raise SettingError("platform height", platform.height, f"at least {below} and plate, {top + _PLATE:g} m")
    _deck(platform, ahead)
    return platform


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
        return _read_boat(given) if given.get("drive") == "boat" else _read_wheeled(given)
    except SettingError as error:
        raise ModelError(f"robot {name}: {error}") from error


def _read_boat(given: Mapping[str, object]) -> BoatModel:
    limits = BoatLimits.from_mapping(given.get("limits", {}), "limits")
    hull = HullSettings.from_mapping(given.get("hull", {}), "hull")
    waves = WaveSettings.from_mapping(given.get("waves", {}), "waves")
    check_step(hull, limits, STEP)
    return BoatModel(limits, hull, waves, _read_platform(given, 0.0, hull.depth - hull.draught, "hull"))


def _read_wheeled(given: Mapping[str, object]) -> RobotModel:
    kind = given.get("drive")
    if kind not in DRIVES:
        raise SettingError("drive", kind, f"{', '.join(DRIVES[:-1])} or {DRIVES[-1]}")
    settings = AckermannLimits if kind == "ackermann" else DifferentialLimits
    limits = settings.from_mapping(given.get("limits", {}), "limits")
    body = BodySettings.from_mapping(given.get("body", {}), "body")
    assert isinstance(limits, DifferentialLimits | AckermannLimits)
    return RobotModel(limits, body, _read_platform(given, body.ahead, body.height, "body"))
