"""AUTO modes: goals and speeds for the control cascade, and their completion (PX4's navigator for multirotors)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from xtdrone_autopilot import c_casts
from xtdrone_autopilot.events.announcements import Announcements
from xtdrone_autopilot.events.events import ERROR
from xtdrone_autopilot.flight_tasks.auto_setpoint import CRITICAL, INFO, NAN, Course, Home, braking_time
from xtdrone_autopilot.flight_tasks.follow_target import FollowTarget
from xtdrone_autopilot.flight_tasks.orbit import Orbit
from xtdrone_autopilot.navigator import feasibility, geofence, plan
from xtdrone_autopilot.navigator.geofence import Fence
from xtdrone_autopilot.navigator.gimbal_manager import NO_CONTROLLER
from xtdrone_autopilot.navigator.mission import Mission, Way
from xtdrone_autopilot.navigator.payload import Payload
from xtdrone_autopilot.navigator.plan import PlanItem, Plans
from xtdrone_autopilot.navigator.precision_landing import PrecisionLanding, from_angles
from xtdrone_autopilot.navigator.rtl import MISSION_REVERSED, Return
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import TASK_GOTO, TASK_IDLE, TASK_LAND
from xtdrone_autopilot.vehicle_view import Vector, VehicleView
from xtdrone_common import modes
from xtdrone_common.modes import Mode

__all__ = ["Goal", "Home", "Navigator"]

_NO_MISSION = "No valid mission available"
_GPS = 1  # GF_SOURCE
_TAKEOFF_MISSION = 1  # COM_TAKEOFF_ACT
_GEOFENCE_WARNS = 1  # GF_ACTION
_GROUND_SPEED = 1  # SPEED_TYPE


@dataclass(frozen=True)
class Goal:
    """Place of a goal, north and east in m, local NED, and whether it is the end of a takeoff."""

    place: tuple[float, float]
    taking_off: bool


class Navigator:
    """AUTO modes of one vehicle.

    Attributes:
        takeoff_altitude: altitude of the next takeoff, m AMSL; NaN for MIS_TAKEOFF_ALT above home.
        takeoff_yaw: heading of the next takeoff, rad; NaN keeps the current one.
        takeoff_place: latitude and longitude at which the next takeoff ends, degrees; NaN for the vehicle's.
        mission: mission execution.
        payload: camera, gimbal and actuators.
        precision_landing: landing on a detected target.
        orbit: circular flight.
        follow_target: flight relative to a target that reports its position.
    """

    def __init__(self, view: VehicleView, parameters: Parameters, announcements: Announcements) -> None:
        """Prepare the AUTO modes; ``activate`` starts one.

        Args:
            view: access to the vehicle's autopilot records.
            parameters: the vehicle's parameters.
            announcements: receives messages for the operator.
        """
        self._view = view
        self._parameters = parameters
        self._tell = announcements.tell
        self._course = Course(view, parameters, announcements)
        self._mode: Mode | None = None
        self.payload = Payload(view)
        self.precision_landing = PrecisionLanding(self._course)
        self.mission = Mission(self._course, self.payload, self.precision_landing)
        self._return = Return(self._course, self.mission, self.precision_landing)
        self.orbit = Orbit(self._course)
        self.follow_target = FollowTarget(self._course)
        self._mission_ended = False
        self._return_way: Way | None = None  # of the mission in a return; None for a return without it
        self._checked: tuple[object, ...] = ()
        self._valid = False
        self._fence = Fence()
        self._fence_key: tuple[object, ...] = ()
        self.takeoff_altitude = NAN
        self.takeoff_yaw = NAN
        self.takeoff_place = (NAN, NAN)

    @property
    def home(self) -> Home | None:
        """Home position, set by the commander; None until the first valid position estimate."""
        return self._course.home

    @home.setter
    def home(self, home: Home | None) -> None:
        self._course.home = home

    @property
    def landing(self) -> bool:
        """Whether the vehicle is landing."""
        return self._course.landing

    @property
    def taking_off(self) -> bool:
        """Whether the vehicle is climbing to its takeoff altitude."""
        return self._course.taking_off

    @property
    def plans(self) -> Plans:
        """Mission, geofence and rally points."""
        return self.mission.plans

    # modes

    def activate(self, mode: Mode) -> None:
        """Start the AUTO mode ``mode`` on an armed vehicle."""
        before = self._mode
        self._stop()
        if mode is not before:
            self._view.setpoint["climb_speed"] = self._view.setpoint["descend_speed"] = NAN
        if mode is modes.AUTO_RTL:
            self._course.cruising_speed = NAN
        self._mode = mode
        if mode not in (modes.AUTO_MISSION, modes.AUTO_LOITER):
            self.mission.require_takeoff()
        if mode is modes.AUTO_TAKEOFF:
            self._start_takeoff()
        elif mode is modes.AUTO_MISSION:
            self._mission_ended = self.mission.activate()
        elif mode is modes.AUTO_FOLLOW_TARGET:
            self.follow_target.start()
        elif self._view.landed:
            self._view.start_task(TASK_IDLE)  # the remaining modes cannot take off
        elif mode is modes.AUTO_LAND:
            self._course.land(self._course.stopping_place())
        elif mode is modes.AUTO_PRECLAND:
            self.precision_landing.start(self._course.stopping_place())
        elif mode is modes.AUTO_RTL:
            self._start_return(before)
        elif mode is modes.ORBIT:
            self.orbit.start()
        else:
            self.hold()

    def end_flight(self) -> None:
        """Leave the AUTO modes of a vehicle that is disarmed, and forget what was commanded for its flight."""
        self.deactivate()
        self.mission.reset()
        self._course.cruising_speed = NAN

    def _start_return(self, before: Mode | None) -> None:
        """Start a return from the AUTO mode ``before``, None for another mode.

        RTL_TYPE 2 flies the mission on to its landing, or back if it has none (PX4 ``Navigator::run``).
        """
        if self._parameters.get("RTL_TYPE") != MISSION_REVERSED:
            self._return.start()
            return
        mission, to_closest = self.mission, before is not modes.AUTO_MISSION
        flyable = not self.mission_denial()
        if flyable and mission.landing_item() is not None:
            self._tell(INFO, "RTL Mission activated, continue mission", "navigator_rtl_mission_activated")
            self._return_way = Way.TO_LANDING
            if before is None:
                mission.go_to_landing()
            else:
                mission.go_on(Way.TO_LANDING, closest=to_closest)
        elif flyable and before not in (None, modes.AUTO_RTL):
            self._tell(INFO, "RTL Mission activated, fly mission in reverse", "navigator_rtl_mission_activated_rev")
            self._return_way = Way.BACK
            if mission.go_on(Way.BACK, closest=to_closest):
                self._return_home()
        else:
            self._tell(INFO, "RTL Mission activated, fly to home", "navigator_rtl_mission_activated_home")
            self._return.start()

    def _return_home(self) -> None:
        """Return without the mission, after it has been flown back."""
        self._return_way = None
        self.mission.deactivate()
        self._return.start()

    def deactivate(self) -> None:
        """Leave the AUTO modes."""
        self._stop()
        self.mission.require_takeoff()
        self._mode = None

    def _stop(self) -> None:
        self.mission.deactivate()
        self._return_way = None
        self.precision_landing.stop()
        self._course.landing = self._course.taking_off = False

    def update(self) -> Mode | None:
        """Advance the active mode; call at 10 Hz.

        Returns:
            The next mode when the active one has ended, for example AUTO.LOITER after a takeoff or a mission; None
            otherwise.
        """
        self.payload.update()
        mode = self._mode
        if mode is modes.AUTO_MISSION:
            return self._update_mission()
        if mode is modes.AUTO_FOLLOW_TARGET:
            self._follow_on()
        if self._return_way is not None:
            self._return_on(self._return_way)
            return None
        if self._view.landed:
            return None
        if mode is modes.AUTO_TAKEOFF and self._course.at_height(self._course.goal[2]):
            return self._after_takeoff()
        if mode is modes.AUTO_RTL:
            self._return.update()
        elif mode is modes.AUTO_PRECLAND:
            self.precision_landing.update()
        elif mode is modes.ORBIT:
            self.orbit.update()
        return None

    def _after_takeoff(self) -> Mode:
        """Return the mode after a takeoff by COM_TAKEOFF_ACT: hold, or the mission if there is one."""
        wants_mission = self._parameters.get("COM_TAKEOFF_ACT") == _TAKEOFF_MISSION
        return modes.AUTO_MISSION if wants_mission and not self.mission_denial() else modes.AUTO_LOITER

    def _follow_on(self) -> None:
        self.follow_target.update()
        gimbal, pitch = self.payload.gimbal_manager, self.follow_target.camera_pitch()
        if gimbal.primary == NO_CONTROLLER and math.isfinite(pitch):  # no yaw: the vehicle faces the target
            gimbal.look((0.0, pitch, 0.0))

    def _return_on(self, way: Way) -> None:
        """Continue a return that flies the mission; after the way back return home.

        A mission that commands a return on the way to its landing holds there, as in PX4, which is returning already.
        """
        if self.mission.update() and way is Way.BACK:
            self._return_home()

    def _update_mission(self) -> Mode | None:
        if self._mission_ended or self.mission.update():
            return modes.AUTO_LOITER
        return modes.AUTO_RTL if self.mission.returning else None

    # plans

    def restore(self, plans: Plans) -> None:
        """Adopt the plans from before a reboot; later changes apply to the same object."""
        self.mission.plans = plans

    def set_plan(self, kind: int, items: Sequence[PlanItem], current: int = -1) -> None:
        """Replace the mission, the geofence or the rally points.

        An active mission continues with the new items at the current index if that is still valid.

        Args:
            kind: ``plan.MISSION``, ``FENCE`` or ``RALLY``.
            items: items in order.
            current: index of the mission item to start with; -1 keeps the current index.

        Raises:
            ValueError: too many items.
        """
        self.plans.replace(kind, items)
        if kind == plan.MISSION:
            self.mission.reset_jump_counts()
            self._begin_at(current)
        else:
            self._checked = ()

    def set_current(self, index: int) -> bool:
        """Set the current mission item to ``index``; return whether the index is valid."""
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

    def mission_denial(self) -> str:
        """Return the reason why AUTO.MISSION cannot be flown, or an empty string."""
        if not self.plans.mission:
            return _NO_MISSION
        self._check()
        return "" if self._valid else _NO_MISSION

    def _check(self) -> None:
        """Validate each new mission once, after the home position is known, as PX4 does."""
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

    # geofence

    def geofence_breach(self) -> str:
        """Return a description of the current geofence breach, or an empty string."""
        if not self._parameters.get("GF_ACTION") or not self._view.has_origin:
            return ""
        return self._breach(self._fence_position)

    def geofence_forbids(self, position: Vector) -> bool:
        """Return whether a geofence with an action beyond a warning excludes ``position`` (m, local NED)."""
        acts = self._parameters.get("GF_ACTION") > _GEOFENCE_WARNS and self._view.has_origin
        return acts and bool(self._breach(lambda: position))

    def _breach(self, get_position: Callable[[], Vector]) -> str:
        get = self._parameters.get
        fence = self._current_fence()
        horizontal, vertical = get("GF_MAX_HOR_DIST"), get("GF_MAX_VER_DIST")
        if not fence.areas and horizontal <= 0.0 and vertical <= 0.0:
            return ""
        position = get_position()
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
        """Return the position to check against the geofence by GF_SOURCE and GF_PREDICT, m, local NED."""
        get = self._parameters.get
        position = self._view.position
        if get("GF_SOURCE") == _GPS:
            s = self._view.sensors
            position = self._view.to_local(float(s["gps_lat"]), float(s["gps_lon"]), float(s["gps_alt"]))
        if not get("GF_PREDICT"):
            return position
        vx, vy, vz = self._view.velocity
        # under constant deceleration the stopping distance is half the braking time times the speed
        ahead = 0.5 * braking_time(math.hypot(vx, vy), get("MPC_ACC_HOR"))
        up = 0.5 * braking_time(abs(vz), get("MPC_ACC_DOWN_MAX" if vz < 0.0 else "MPC_ACC_UP_MAX"))
        return position[0] + vx * ahead, position[1] + vy * ahead, position[2] + vz * up

    def _current_fence(self) -> Fence:
        items = self.plans.items[plan.FENCE]
        if not items and not self._fence.areas:
            return self._fence
        wanted = (id(self.plans), self.plans.changes[plan.FENCE], self._view.origin)
        if wanted != self._fence_key:
            self._fence_key = wanted
            self._fence = geofence.build(items, self._to_plane)
        return self._fence

    def _to_plane(self, latitude: float, longitude: float) -> tuple[float, float]:
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            return NAN, NAN
        return self._view.to_local(latitude, longitude, 0.0)[:2]

    def _fence_allows(self, latitude: float, longitude: float, altitude: float) -> bool:
        """Return whether the geofence allows a position (degrees, m AMSL)."""
        x, y = self._to_plane(latitude, longitude)
        position = (x, y, self._view.origin[2] - altitude)
        return not self._breach(lambda: position)

    # precision landing

    def set_landing_target(self, position: Vector, time_us: int = 0) -> None:
        """Store the position of the landing target; ignore it unless finite.

        Args:
            position: m, local NED.
            time_us: simulated time of the observation, microseconds; one not within the last second counts as now.
        """
        if all(map(math.isfinite, position)):
            self.precision_landing.see(position, time_us)

    def set_landing_target_angles(self, x: float, y: float, distance: float) -> None:
        """Store the position of a landing target observed at the given angles.

        Args:
            x: angle forward from straight down, rad.
            y: angle to the right from straight down, rad.
            distance: distance to the target, m; 0 or less if unknown, which assumes the ground at home altitude.
        """
        position = self._view.position
        height = distance if distance > 0.0 else self._course.ground - position[2]
        self.set_landing_target(from_angles(x, y, height, position, self._view.yaw))

    # commands

    def hold(self) -> None:
        """Stop and hold position."""
        self._course.hold()

    def reposition(self, position: Vector, yaw: float, speed: float = NAN) -> None:
        """Fly to ``position``.

        Args:
            position: m, local NED.
            yaw: rad; NaN turns towards a goal beyond NAV_ACC_RAD.
            speed: horizontal speed to this goal alone, m/s; NaN for that of ``change_speed``.
        """
        if math.isnan(yaw) and self._course.distance_to(position) > self._parameters.get("NAV_ACC_RAD"):
            yaw = self._course.bearing_to(position)
        self._course.fly_to(position, yaw, speed=speed)

    def goal_before_a_pause(self) -> Goal:
        """Return what a command that holds the vehicle may keep of the goal that it replaces."""
        has_goal = self._mode is not None and self._view.task in (TASK_GOTO, TASK_LAND)
        x, y, _ = self._course.goal if has_goal else self._view.position
        return Goal((x, y), self._course.taking_off)

    def pause(self, goal: Goal, z: float = NAN) -> None:
        """Brake and hold the position and heading reached, at ``z`` (m, local NED; NaN for the vehicle's height).

        During a takeoff the place of its goal stays, as in PX4.
        """
        x, y, here = self._course.stopping_place()
        if goal.taking_off:
            x, y = goal.place
        self._course.fly_to((x, y, here if math.isnan(z) else z), NAN if goal.taking_off else self._view.yaw)

    def change_speed(self, kind: float, speed: float) -> None:
        """Set the horizontal speed of AUTO modes until a return, the disarming or the next change.

        PX4's navigator keeps it for the goals to come, and its flight task takes a ground speed at once.

        Args:
            kind: SPEED_TYPE, of which only ground speed is distinguished.
            speed: m/s; 0 or less, and NaN, restore MPC_XY_CRUISE.
        """
        at_once = c_casts.to_byte(kind + 0.5) == _GROUND_SPEED and speed > 0.0
        self._course.set_cruising_speed(speed, at_once=at_once or self._mode is modes.AUTO_MISSION)

    def _start_takeoff(self) -> None:
        x, y, z = self._view.position
        if self._view.has_origin and all(map(math.isfinite, self.takeoff_place)):
            x, y, _ = self._view.to_local(*self.takeoff_place, 0.0)
        ground = self._course.ground
        min_altitude = self._parameters.get("MIS_TAKEOFF_ALT")
        wanted = self._view.origin[2] - self.takeoff_altitude if self._view.has_origin else NAN
        goal = ground - min_altitude if math.isnan(wanted) else min(wanted, ground - min_altitude)
        if z < goal and not self._view.landed:
            self._tell(
                CRITICAL, "Already higher than takeoff altitude", "navigator_takeoff_already_higher", level=ERROR
            )
            goal = z
        elif goal != wanted:
            self._tell(
                INFO, f"Using minimum takeoff altitude: {min_altitude:.2f} m", "navigator_takeoff_min_alt", min_altitude
            )
        self._course.take_off((x, y, goal), self.takeoff_yaw)
        self.takeoff_altitude = self.takeoff_yaw = NAN
        self.takeoff_place = (NAN, NAN)
