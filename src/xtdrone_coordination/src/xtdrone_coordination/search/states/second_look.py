"""Second look: circle a candidate until the images confirm or reject it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.pinhole import Pinhole

from ..coverage_map import shows
from ..people.candidates import EXTRAPOLATION, Candidate
from ..reports import round_xy
from ..searching_vehicle import OFFBOARD, LookStage, PointCamera, SecondLook, State, Vehicle
from .common_supervision import MissionControl
from .offboard_heights_and_setpoints import OffboardState

_OFFBOARD_DELAY = 0.3  # s for the first setpoint to arrive before the mode is requested
_MIN_RADIUS, _MAX_RADIUS = 3.0, 25.0  # m
_MAX_TURN_RATE = 0.35  # rad/s around a candidate


class TakingSecondLook(OffboardState):
    """Approaches a candidate, descends and circles it."""

    needs_camera = True

    def __init__(self, control: MissionControl, camera: Pinhole) -> None:
        super().__init__(control)
        self._camera = camera

    def begin(self, vehicle: Vehicle, candidate: Candidate, takes_over: float | None) -> None:
        """Send a vehicle to a candidate.

        Args:
            vehicle: the vehicle.
            candidate: the candidate.
            takes_over: remaining time of the following to take over, s; None for a first look.
        """
        assert vehicle.position is not None
        now = self._control.now
        x, y, _ = vehicle.position
        place = candidate.place(now)
        angle = math.atan2(y - place[1], x - place[0])
        vehicle.look = SecondLook(candidate, vehicle.state, (x, y), vehicle.yaw, angle, now, takes_over)
        candidate.status = "looked at"
        candidate.looked_by.add(vehicle.name)
        vehicle.setpoint = vehicle.position
        vehicle.request_mode(OFFBOARD, now, _OFFBOARD_DELAY)
        vehicle.enter(State.SECOND_LOOK, now)
        self._control.report("second_look", vehicle, position=round_xy(place), takes_over=takes_over is not None)

    def update(self, vehicle: Vehicle, dt: float) -> None:
        """Move the setpoint on to and around the circle, and decide."""
        look, settings = vehicle.look, self._control.settings
        assert look is not None
        height = self._look_height(vehicle)
        radius = height / math.tan(math.radians(-settings.look_pitch))
        radius = min(max(radius, _MIN_RADIUS), _MAX_RADIUS)
        if look.stage is LookStage.CIRCLE:
            step = min(settings.look_speed / radius, _MAX_TURN_RATE) * dt
            look.angle += step
            look.turned += step
        x, y = look.candidate.place(self._control.now)
        z = settings.ground + height if look.stage is not LookStage.APPROACH else vehicle.search_altitude
        target = (x + radius * math.cos(look.angle), y + radius * math.sin(look.angle), z)
        self._move_setpoint(vehicle, target, look.angle + math.pi, dt)
        assert vehicle.position is not None
        if look.stage is LookStage.APPROACH and vehicle.distance_to(target[:2]) < 3.0:
            look.stage = LookStage.DESCEND
            self._control.act(PointCamera(vehicle.name, settings.look_pitch))
        elif look.stage is LookStage.DESCEND and abs(vehicle.position[2] - z) < 1.0:
            look.stage = LookStage.CIRCLE
        self._decide(vehicle, look)

    def observe(
        self,
        look: SecondLook,
        time: float,
        position: NDArray[np.float64],
        rotation: NDArray[np.float64],
        probability: float | None,
    ) -> None:
        """Add an image to the evidence of a look.

        Args:
            look: the second look.
            time: Time of the exposure, s.
            position: (3,) of the camera, m, map.
            rotation: (3, 3) from the optical frame to the map frame.
            probability: that the candidate is a person; None if the image does not show it.
        """
        if look.stage not in (LookStage.DESCEND, LookStage.CIRCLE):
            return
        candidate = look.candidate
        if probability is not None:
            look.evidence.hit(probability)
        elif look.takes_over is None or time - candidate.seen_at <= EXTRAPOLATION:  # later its place is unknown
            x, y = candidate.place(time)
            if shows(self._camera, position, rotation, np.array([[x, y, self._control.settings.ground]]))[0]:
                look.evidence.miss()

    def _decide(self, vehicle: Vehicle, look: SecondLook) -> None:
        settings, evidence = self._control.settings, look.evidence
        if (
            evidence.log_odds >= settings.confirm_log_odds
            and evidence.hits >= settings.confirm_hits
            and evidence.mean >= settings.confirm_probability
            and look.turned >= math.radians(settings.look_arc)
        ):
            self._confirm(vehicle, look)
        elif evidence.log_odds <= settings.reject_log_odds or self._control.now - look.begun > settings.look_time:
            self._reject(vehicle, look)

    def _confirm(self, vehicle: Vehicle, look: SecondLook) -> None:
        look.candidate.status, look.candidate.found = "confirmed", True
        vehicle.look = None
        if look.takes_over is None:
            self._control.record_find(vehicle, look)
        self._control.begin_following(vehicle, look)

    def _reject(self, vehicle: Vehicle, look: SecondLook) -> None:
        candidate, evidence = look.candidate, look.evidence
        candidate.status = "rejected"
        self._control.report(
            "rejected",
            vehicle,
            position=round_xy(candidate.position),
            probability=round(evidence.mean, 3),
            pictures=evidence.pictures,
            hits=evidence.hits,
        )
        look.stage = LookStage.CLIMB
        vehicle.enter(State.REJOINING, self._control.now)
        if look.takes_over is not None:
            self._control.hand_over(candidate, look.takes_over)
