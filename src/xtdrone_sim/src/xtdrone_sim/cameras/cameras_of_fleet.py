"""Cameras of a fleet and the schedule of their exposures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from xtdrone_common.cameras import drawing_of
from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import Pose, compose
from xtdrone_common.settings import check_range
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.vehicles.vehicle_model import CameraMount, load_vehicle

LEAST_TURNS = 10.0  # Hz, minimum rate of the node's turns, which take and publish the images
MOST_TURNS = 50.0  # Hz, rate of /xtdrone/scene


@dataclass(frozen=True)
class Camera:
    """A camera of one vehicle.

    Attributes:
        vehicle: name, e.g. ``typhoon_h480_0``.
        mount: its position and properties.
    """

    vehicle: str
    mount: CameraMount

    @property
    def topics(self) -> str:
        """Namespace of its topics."""
        return f"/{self.vehicle}/{self.mount.name}"

    @property
    def frame_id(self) -> str:
        """Its optical frame."""
        return f"{self.vehicle}/{self.mount.frame_id}"

    @property
    def views(self) -> tuple[View, ...]:
        """The views that the renderer draws for an exposure.

        With depths, the view of the pinhole comes first. For a lens or without depths the views of each eye follow;
        those of a lens are the faces of its drawing (``lens_drawing.drawing_of``). The left eye of a stereo pair comes
        first.
        """
        m = self.mount
        link = f"{self.vehicle}::{m.link}"
        plain = [View(link, m.pinhole, m.near, m.far, pose, m.has_depth) for _, pose in m.eyes]
        if m.lens is None:
            return tuple(plain)
        drawing = drawing_of(m.lens)
        turned = [compose(pose, Pose(orientation=face)) for _, pose in m.eyes for face in drawing.faces]
        faces = [View(link, drawing.pinhole, m.near, m.far, pose) for pose in turned]
        return (*(plain if m.has_depth else ()), *faces)


def cameras_of(fleet: Sequence[Vehicle]) -> tuple[Camera, ...]:
    """Return all cameras of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    mounts = {kind: load_vehicle(kind).cameras for kind in dict.fromkeys(vehicle.model for vehicle in fleet)}
    return tuple(Camera(vehicle.name, mount) for vehicle in fleet for mount in mounts[vehicle.model])


def turn_rate(rates: Sequence[float]) -> float:
    """Return the rate of turns that a node needs to take images at these rates, Hz.

    With one rate for all cameras, the result is a multiple of it, so images are evenly spaced.

    Raises:
        ValueError: a rate is outside 0.1 to 50 Hz.
    """
    for rate in rates:
        check_range("rate", rate, 0.1, MOST_TURNS, "Hz")
    fastest = max(rates, default=LEAST_TURNS)
    return min(MOST_TURNS, fastest * math.ceil(LEAST_TURNS / fastest))


class Exposures:
    """Schedule of exposures: each camera at its rate, with offsets that spread the cameras over the turns."""

    def __init__(self, rates: Sequence[float], turns: float) -> None:
        """Create the schedule.

        Args:
            rates: rates of the cameras, Hz; at most ``turns``.
            turns: rate of the node's turns, Hz.
        """
        self._turns = Fraction(turns).limit_denominator(1000)
        shares = [Fraction(rate).limit_denominator(1000) / self._turns for rate in rates]
        # The k-th of n cameras is ahead by k / n of the interval between two images.
        self._schedule = [(share, Fraction(k, len(rates))) for k, share in enumerate(shares)]

    def due(self, time_us: int) -> list[int]:
        """Return the indices of the cameras that expose in the turn at a simulated time, microseconds."""
        turn = math.floor(time_us * self._turns / 1_000_000)
        return [
            index
            for index, (share, ahead) in enumerate(self._schedule)
            if math.floor((turn + 1) * share + ahead) > math.floor(turn * share + ahead)
        ]
