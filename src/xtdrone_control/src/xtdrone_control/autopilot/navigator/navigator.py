"""What AUTO modes ask of the cascade: goals, speeds, and when they are reached (PX4's navigator, multirotors)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.events.announcements import Announcements
from xtdrone_control.autopilot.events.events import ERROR
from xtdrone_control.autopilot.flight_tasks.auto_setpoint import CRITICAL, INFO, NAN, Course, Home, braking_time
from xtdrone_control.autopilot.flight_tasks.follow_target import FollowTarget
from xtdrone_control.autopilot.flight_tasks.orbit import Orbit
from xtdrone_control.autopilot.modes import Mode
from xtdrone_control.autopilot.navigator import feasibility, geofence, plan
from xtdrone_control.autopilot.navigator.geofence import Fence
from xtdrone_control.autopilot.navigator.gimbal import NOBODY
from xtdrone_control.autopilot.navigator.mission import Mission
from xtdrone_control.autopilot.navigator.payload import Payload
from xtdrone_control.autopilot.navigator.plan import PlanItem, Plans
from xtdrone_control.autopilot.navigator.precision_landing import PrecisionLanding, from_angles
from xtdrone_control.autopilot.navigator.rtl import Return
from xtdrone_control.autopilot.parameters.parameters import Parameters
from xtdrone_control.autopilot.state import TASK_IDLE
from xtdrone_control.autopilot.vehicle_view import Vector, VehicleView
from xtdrone_control.geodesy import geo

__all__ = ["Home", "Navigator"]

_NO_MISSION = "No valid mission available"
_GPS = 1  # GF_SOURCE
_GEOFENCE_WARNS = 1  # GF_ACTION


class Navigator:
    """The AUTO modes of one vehicle.

    Attributes:
        takeoff_altitude: m AMSL that a takeoff was asked for; NaN for MIS_TAKEOFF_ALT over home.
        takeoff_yaw: rad, NaN keeps the heading.
        mission: what flies the mission.
        payload: camera, gimbal and actuators that a mission commands.
        precision_landing: takes the landing target that somebody sees.
        orbit: what flies circles.
        follow_target: what follows a target that reports where it is.
    """

    def __init__(self, view: VehicleView, parameters: Parameters, announcements: Announcements) -> None:
        """Prepare; nothing is asked of the cascade until ``activate``.

        Args:
            view: the vehicle.
            parameters: its parameters.
            announcements: takes what the operator is told.
        """
        self._view = view
        self._parameters = parameters
        self._tell = announcements.tell
        self._course = Course(view, parameters, announcements)
        self._mode: Mode | None = None
        self.payload = Payload(view)
        self.precision_landing = PrecisionLanding(self._course)
        self.mission = Mission(self._course, self.payload, self.precision_landing)
        self.mission.set_home = self._set_home
        self._return = Return(self._course, self.mission, self.precision_landing)
        self.orbit = Orbit(self._course)
        self.follow_target = FollowTarget(self._course)
        self._mission_ended = False
        self._checked: tuple[object, ...] = ()
        self._valid = False
        self._fence = Fence()
        self._fence_for: tuple[object, ...] = ()
        self.takeoff_altitude = NAN
        self.takeoff_yaw = NAN

    @property
    def home(self) -> Home | None:
        """Where a return goes to; set by the commander, None until the first valid position."""
        return self._course.home

    @home.setter
    def home(self, home: Home | None) -> None:
        self._course.home = home

    @property
    def landing(self) -> bool:
        """Whether the vehicle is on its way to the ground."""
        return self._course.landing

    @property
    def taking_off(self) -> bool:
        """Whether the vehicle climbs to where a takeoff ends."""
        return self._course.taking_off

    @property
    def plans(self) -> Plans:
        """Mission, geofence and rally points."""
        return self.mission.plans

    # modes

    def activate(self, mode: Mode) -> None:
        """Begin ``mode``, one of the AUTO modes, for an armed vehicle."""
        self._stop()
        if mode is not self._mode:  # a speed that was commanded holds until the next mode
            for field in ("cruise_speed", "climb_speed", "descend_speed"):
                self._view.setpoint[field] = NAN
        self._mode = mode
        if mode is modes.AUTO_TAKEOFF:
            self._start_takeoff()
        elif mode is modes.AUTO_MISSION:
            self._mission_ended = self.mission.activate()
        elif mode is modes.AUTO_FOLLOW_TARGET:
            self.follow_target.start()
        elif self._view.landed:
            self._view.start_task(TASK_IDLE)  # these modes do not leave the ground
        elif mode is modes.AUTO_LAND:
            self._course.land(self._course.stopping_place())
        elif mode is modes.AUTO_PRECLAND:
            self.precision_landing.start(self._course.stopping_place())
        elif mode is modes.AUTO_RTL:
            self._return.start()
        elif mode is modes.ORBIT:
            self.orbit.start()
        else:
            self.hold()

    def deactivate(self) -> None:
        """Leave the AUTO modes."""
        self._stop()
        self._mode = None

    def _stop(self) -> None:
        self.mission.deactivate()
        self.precision_landing.stop()
        self._course.landing = self._course.taking_off = False

    def update(self) -> Mode | None:
        """Go on to the mode's next phase when the present one is done; call at 10 Hz.

        Returns:
            The mode to go on with, when the present one has come to its end: a takeoff that has reached its height
            goes on in AUTO.LOITER, as does a mission that is done.
        """
        self.payload.update()
        mode = self._mode
        if mode is modes.AUTO_MISSION:
            return self._update_mission()
        if mode is modes.AUTO_FOLLOW_TARGET:
            self._follow_on()
        if self._view.landed:
            return None
        if mode is modes.AUTO_TAKEOFF and self._course.at_height(self._course.goal[2]):
            return modes.AUTO_LOITER
        if mode is modes.AUTO_RTL:
            self._return.update()
        elif mode is modes.AUTO_PRECLAND:
            self.precision_landing.update()
        elif mode is modes.ORBIT:
            self.orbit.update()
        return None

    def _follow_on(self) -> None:
        self.follow_target.update()
        gimbal, pitch = self.payload.gimbal_manager, self.follow_target.camera_pitch()
        if gimbal.primary == NOBODY and math.isfinite(pitch):  # yaw: the vehicle faces the target
            gimbal.look((0.0, pitch, 0.0))

    def _update_mission(self) -> Mode | None:
        if self._mission_ended or self.mission.update():
            return modes.AUTO_LOITER
        if self.mission.returning:
            self._tell(INFO, "Returning to launch", "commander_rtl")
            return modes.AUTO_RTL
        return None

    # plans

    def restore(self, plans: Plans) -> None:
        """Take the plans of before a reboot; what is changed from now on is changed in them."""
        self.mission.plans = plans

    def set_plan(self, kind: int, items: Sequence[PlanItem], current: int = -1) -> None:
        """Replace the mission, the geofence or the rally points.

        A mission that is being flown goes on with the new items, from the same index as far as there is one.

        Args:
            kind: ``plan.MISSION``, ``FENCE`` or ``RALLY``.
            items: in order.
            current: index of the mission item to begin with; -1 for none in particular.

        Raises:
            ValueError: too many items.
        """
        self.plans.replace(kind, items)
        if kind == plan.MISSION:
            self.mission.forget_jumps()
            self._begin_at(current)
        else:
            self._checked = ()

    def set_current(self, index: int) -> bool:
        """Fly mission item ``index`` next; return whether there is such an item."""
        if not 0 <= index < len(self.plans.mission):
            return False
        self._begin_at(index)
        return True

    def _begin_at(self, current: int) -> None:
        self.mission.load(current)
        self._checked = ()
        self._check()
        if self._mode is modes.AUTO_MISSION:
            self._mission_ended = self.mission.restart_item() if self._valid else self._end_mission()

    def _end_mission(self) -> bool:
        self._tell(INFO, "Mission finished, loitering", "mission_finished_loiter")
        return True

    def mission_obstacle(self) -> str:
        """Return why AUTO.MISSION cannot be flown, or an empty text."""
        self._check()
        return "" if self._valid else _NO_MISSION

    def _check(self) -> None:
        """Look once at every new mission whether it can be flown; not before there is a home, as PX4."""
        home = self.home
        wanted = (id(self.plans), *self.plans.changes, home is None)
        if wanted == self._checked:
            return
        self._checked = wanted
        self._valid = False
        if home is None or not self.plans.mission:
            return
        get = self._parameters.get
        latitude, longitude, _ = self._view.to_global(self._view.position)
        now = feasibility.Situation(
            home.altitude,
            (latitude, longitude),
            self._view.landed,
            float(get("MIS_DIST_1WP")),
            int(get("MIS_TKO_LAND_REQ")),
            self._fence_allows,
        )
        self._valid = feasibility.check(self.plans.mission, now, self._tell)

    def _set_home(self, place: Vector | None) -> None:
        """Set home as an item of the mission says: to latitude, longitude, m AMSL, or to where the vehicle is."""
        if place is not None and not geo.is_place(*place):
            return
        position = self._view.position if place is None else self._view.to_local(*place)
        where = self._view.to_global(position) if place is None else place
        if all(map(math.isfinite, where)):
            self.home = Home(*where, position, self._view.yaw, self._view.time_us)

    # geofence

    def geofence_breach(self) -> str:
        """Return by what the vehicle breaks its geofence, or an empty text."""
        if not self._parameters.get("GF_ACTION") or not self._view.has_origin:
            return ""
        return self._breach(self._fence_position)

    def fenced_off(self, position: Vector) -> bool:
        """Return whether a geofence that does more than warn keeps the vehicle from ``position`` (m, local NED)."""
        acts = self._parameters.get("GF_ACTION") > _GEOFENCE_WARNS and self._view.has_origin
        return acts and bool(self._breach(lambda: position))

    def _breach(self, place: Callable[[], Vector]) -> str:
        get = self._parameters.get
        fence = self._present_fence()
        horizontal, vertical = get("GF_MAX_HOR_DIST"), get("GF_MAX_VER_DIST")
        if not fence.areas and horizontal <= 0.0 and vertical <= 0.0:
            return ""
        position = place()
        home = self.home
        if home is not None:
            away = math.hypot(position[0] - home.position[0], position[1] - home.position[1])
            up = home.position[2] - position[2]
            if vertical > 0.0 and up > vertical:
                return f"Maximum altitude above home exceeded by {up - vertical:.1f} m"
            if horizontal > 0.0 and away > horizontal:
                return f"Maximum distance from home exceeded by {away - horizontal:.1f} m"
        return "" if fence.allows(position[:2]) else "Geofence violation"

    def _fence_position(self) -> Vector:
        """Return the place that GF_SOURCE and GF_PREDICT want to be inside: m, local NED."""
        get = self._parameters.get
        position = self._view.position
        if get("GF_SOURCE") == _GPS:
            s = self._view.sensors
            position = self._view.to_local(float(s["gps_lat"]), float(s["gps_lon"]), float(s["gps_alt"]))
        if not get("GF_PREDICT"):
            return position
        vx, vy, vz = self._view.velocity
        # half of it, times v: where the vehicle stops when it brakes now
        ahead = 0.5 * braking_time(math.hypot(vx, vy), get("MPC_ACC_HOR"))
        up = 0.5 * braking_time(abs(vz), get("MPC_ACC_DOWN_MAX" if vz < 0.0 else "MPC_ACC_UP_MAX"))
        return position[0] + vx * ahead, position[1] + vy * ahead, position[2] + vz * up

    def _present_fence(self) -> Fence:
        items = self.plans.items[plan.FENCE]
        if not items and not self._fence.areas:
            return self._fence
        wanted = (id(self.plans), self.plans.changes[plan.FENCE], self._view.origin)
        if wanted != self._fence_for:
            self._fence_for = wanted
            self._fence = geofence.build(items, self._to_plane)
        return self._fence

    def _to_plane(self, latitude: float, longitude: float) -> tuple[float, float]:
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            return NAN, NAN
        return self._view.to_local(latitude, longitude, 0.0)[:2]

    def _fence_allows(self, latitude: float, longitude: float, altitude: float) -> bool:
        """Return whether a place (degrees, m AMSL) is inside the geofence."""
        x, y = self._to_plane(latitude, longitude)
        position = (x, y, self._view.origin[2] - altitude)
        return not self._breach(lambda: position)

    # precision landing

    def see_landing_target(self, position: Vector) -> None:
        """Note where the landing target was seen, m, local NED; what is not finite is not noted."""
        if all(map(math.isfinite, position)):
            self.precision_landing.see(position)

    def see_landing_target_at(self, x: float, y: float, distance: float) -> None:
        """Note at which angles the landing target was seen from above.

        Args:
            x: rad, forwards from straight down.
            y: rad, to the right.
            distance: m to the target; not positive: the ground is as high as home.
        """
        place = self._view.position
        height = distance if distance > 0.0 else self._course.ground - place[2]
        self.see_landing_target(from_angles(x, y, height, place, self._view.yaw))

    # what commands ask for

    def hold(self) -> None:
        """Stop, and stay there."""
        self._course.hold()

    def reposition(self, position: Vector, yaw: float) -> None:
        """Fly to ``position`` (m, local NED) with heading ``yaw`` (rad; NaN: look where it goes)."""
        if math.isnan(yaw) and self._course.distance_to(position) > self._parameters.get("NAV_ACC_RAD"):
            yaw = self._course.bearing_to(position)
        self._course.fly_to(position, yaw)

    def change_altitude(self, z: float) -> None:
        """Climb or sink to ``z`` (m, local NED) over the present goal."""
        x, y, _ = self._course.goal
        self._course.fly_to((x, y, z))

    def set_speed(self, field: str, speed: float) -> None:
        """Set cruise_speed, climb_speed or descend_speed (m/s) until the next mode; NaN for the parameter's."""
        self._view.setpoint[field] = speed

    def _start_takeoff(self) -> None:
        x, y, z = self._view.position
        ground = self._course.ground
        least = self._parameters.get("MIS_TAKEOFF_ALT")
        wanted = self._view.origin[2] - self.takeoff_altitude if self._view.has_origin else NAN
        goal = ground - least if math.isnan(wanted) else min(wanted, ground - least)
        if z < goal and not self._view.landed:
            self._tell(
                CRITICAL, "Already higher than takeoff altitude", "navigator_takeoff_already_higher", level=ERROR
            )
            goal = z
        elif goal != wanted:
            self._tell(INFO, f"Using minimum takeoff altitude: {least:.2f} m", "navigator_takeoff_min_alt", least)
        self._course.take_off((x, y, goal), self.takeoff_yaw)
        self.takeoff_altitude = self.takeoff_yaw = NAN
