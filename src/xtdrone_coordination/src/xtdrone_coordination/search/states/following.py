"""Following: yolo_human_tracking flies the vehicle; the mission control watches the time and the track."""

from __future__ import annotations

from ..people.candidates import Candidate
from ..reports import round_xy
from ..searching_vehicle import Follow, Following, SecondLook, State, Vehicle
from .common_supervision import MissionControl
from .offboard_heights_and_setpoints import OffboardState, Rejoining


class FollowingPerson(OffboardState):
    """Follows a confirmed person for ``follow_time``."""

    needs_camera = True

    def __init__(self, control: MissionControl, rejoining: Rejoining) -> None:
        super().__init__(control)
        self._rejoining = rejoining

    def begin(self, vehicle: Vehicle, look: SecondLook) -> None:
        """Follow the person that a second look has confirmed, for the rest of the time if it takes over."""
        candidate, now = look.candidate, self._control.now
        duration = self._control.settings.follow_time if look.takes_over is None else look.takes_over
        track = candidate.track[vehicle.name]
        vehicle.following = Following(candidate, now, now + duration, track, look)
        vehicle.enter(State.FOLLOWING, now)
        vehicle.setpoint = None
        self._control.act(Follow(vehicle.name, track))
        self._control.report("following", vehicle, position=round_xy(candidate.position), track=track)

    def update(self, vehicle: Vehicle, dt: float) -> None:
        """End the following after its time or the loss of the person; keep up with the person's track id."""
        following, now = vehicle.following, self._control.now
        assert following is not None
        if now >= following.until:
            self.end(vehicle, "time")
            if self._control.found:
                self._control.return_home(vehicle, "following has ended")
            else:
                self._rejoining.begin(vehicle, following.look)
        elif now - max(following.seen, following.since) > self._control.settings.lose_time:
            self._on_person_lost(vehicle, following)
        else:
            track = following.candidate.track.get(vehicle.name, following.track)
            if track != following.track:  # the camera has found the lost person again
                following.track = track
                self._control.act(Follow(vehicle.name, track))

    def _on_person_lost(self, vehicle: Vehicle, following: Following) -> None:
        """Hand the person over to another vehicle; look again if none is available."""
        remaining = following.until - self._control.now
        self.end(vehicle, "lost")
        self.release(following.candidate, vehicle)
        if self._control.hand_over(following.candidate, remaining):
            self._rejoining.begin(vehicle, following.look)
        else:
            vehicle.enter(following.look.came_from, self._control.now)
            self._control.begin_look(vehicle, following.candidate, remaining)

    def end(self, vehicle: Vehicle, reason: str) -> None:
        """Stop following and report the duration."""
        following, vehicle.following = vehicle.following, None
        assert following is not None
        self._control.act(Follow(vehicle.name, -1))
        duration = round(self._control.now - following.since, 3)
        self._control.report("follow_ended", vehicle, reason=reason, duration=duration)

    @staticmethod
    def release(candidate: Candidate, vehicle: Vehicle) -> None:
        """Leave a candidate to all vehicles but the one that has followed it."""
        candidate.status = "seen"
        candidate.looked_by = {vehicle.name}
