"""The cameras of a fleet, and which of them exposes when."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from xtdrone_control.fleet import Vehicle
from xtdrone_control.settings import check_range
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.vehicles.vehicle_model import CameraMount, load_vehicle

LEAST_TURNS = 10.0  # Hz; a picture is taken and published in turns of the node
MOST_TURNS = 50.0  # Hz; the scene is told so often


@dataclass(frozen=True)
class Camera:
    """A camera of one vehicle.

    Attributes:
        vehicle: name, as ``typhoon_h480_0``.
        mount: where and what it is.
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
    def view(self) -> View:
        """What it takes pictures of."""
        return View(f"{self.vehicle}::{self.mount.link}", self.mount.pinhole, self.mount.near, self.mount.far)


def cameras_of(fleet: Sequence[Vehicle]) -> tuple[Camera, ...]:
    """Return all cameras of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    mounts = {kind: load_vehicle(kind).cameras for kind in dict.fromkeys(vehicle.type for vehicle in fleet)}
    return tuple(Camera(vehicle.name, mount) for vehicle in fleet for mount in mounts[vehicle.type])


def turn_rate(rates: Sequence[float]) -> float:
    """Return how often a node must have its turn to take pictures at these rates, Hz.

    With one rate for all, pictures are evenly apart: it is a multiple of that rate.

    Raises:
        ValueError: a rate is not in 0.1 to 50 Hz.
    """
    for rate in rates:
        check_range("rate", rate, 0.1, MOST_TURNS, "Hz")
    fastest = max(rates, default=LEAST_TURNS)
    return min(MOST_TURNS, fastest * math.ceil(LEAST_TURNS / fastest))


class Exposures:
    """Which camera exposes in which turn: each at its rate, all spread evenly over the turns between two pictures."""

    def __init__(self, rates: Sequence[float], turns: float) -> None:
        """Keep the rates.

        Args:
            rates: of the cameras, Hz; at most ``turns``.
            turns: of the node, Hz.
        """
        self._turns = Fraction(turns).limit_denominator(1000)
        shares = [Fraction(rate).limit_denominator(1000) / self._turns for rate in rates]
        # Of n cameras, the k-th is ahead by k / n of the way from one picture to the next.
        self._schedule = [(share, Fraction(k, len(rates))) for k, share in enumerate(shares)]

    def due(self, time_us: int) -> list[int]:
        """Return the indices of the cameras that expose in the turn that falls on a simulated time, microseconds."""
        turn = math.floor(time_us * self._turns / 1_000_000)
        return [
            index
            for index, (share, ahead) in enumerate(self._schedule)
            if math.floor((turn + 1) * share + ahead) > math.floor(turn * share + ahead)
        ]
