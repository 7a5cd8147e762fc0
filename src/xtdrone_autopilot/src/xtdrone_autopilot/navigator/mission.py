"""Mission execution, modelled on PX4 v1.14's navigator for multicopters (``Mission``, ``MissionBlock``)."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import replace

from xtdrone_autopilot.events.events import ERROR
from xtdrone_autopilot.flight_tasks.auto_setpoint import CRITICAL, FLT_EPSILON, INFO, NAN, UNSET, Course
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.payload import Payload
from xtdrone_autopilot.navigator.plan import PlanItem, Plans
from xtdrone_autopilot.navigator.precision_landing import PrecisionLanding
from xtdrone_autopilot.vehicle_view import Vector

_MAX_JUMPS = 10  # consecutive; more are treated as a cycle
_NEEDS_TAKEOFF = (plan.TAKEOFF, plan.WAYPOINT, plan.LOITER_TIME, plan.LOITER_UNLIM)
_PAYLOAD_WAITS = (plan.GRIPPER, plan.WINCH)
_WAITING = (plan.LOITER_TIME, plan.LOITER_UNLIM)
_LOITERS = (*_WAITING, plan.LOITER_TO_ALT)
_PRECISE = (1, 2)
_NEVER_US = -(1 << 60)
_LANDING_KEPT_US = 2_000_000  # after a landing's interruption, in which a return continues it
_ROI_NONE, _ROI_NEXT, _ROI_LOCATION = 0, 1, 3  # MAV_ROI


class _Stage(enum.Enum):
    """Stage of the current item: a preparatory manoeuvre or the item itself."""

    ITEM = enum.auto()
    TAKEOFF = enum.auto()
    MOVE_TO_LAND = enum.auto()
    PRECISION_LAND = enum.auto()


class Way(enum.Enum):
    """How a mission is flown (PX4's mission execution modes)."""

    NORMAL = enum.auto()
    TO_LANDING = enum.auto()  # without waits and jumps
    BACK = enum.auto()  # its positions in reverse order, as waypoints


class Mission:
    """Mission of one vehicle.

    Attributes:
        plans: mission, geofence and rally points.
        reached: index of the item reached last, -1 for none.
        returning: whether the mission has reached an item that commands a return, or has failed.
        set_home: sets the home position to (latitude, longitude, altitude), degrees and m AMSL, with a heading, rad,
            NaN if unknown; or to the vehicle's current position (None).
    """

    def __init__(self, course: Course, payload: Payload, landing: PrecisionLanding) -> None:
        """Prepare an inactive mission; ``activate`` starts it."""
        self._course = course
        self._view = course.view
        self._get = course.parameters.get
        self._tell = course.announcements.tell
        self._payload = payload
        self._landing = landing
        self.plans = Plans()
        self.reached = -1
        self.returning = False
        self.set_home: Callable[[Vector | None, float], object] = lambda _location, _yaw: None
        self._active = False
        self._way = Way.NORMAL
        self._left_us = _NEVER_US
        self._flown = False
        self._item: PlanItem | None = None
        self._target: Vector = (0.0, 0.0, 0.0)
        self._yaw = NAN
        self._loitering = False  # whether the vehicle stays at its goal, whatever follows
        self._stage = _Stage.ITEM
        self._need_takeoff = True
        self._past_end = False  # whether the item after the last one is the next
        self._jumps: dict[int, int] = {}
        self._reached_target = False
        self._reached_heading = False
        self._reached_us: int | None = None
        self._roi_kind = _ROI_NONE
        self._roi: Vector | None = None
        self._roi_offset = 0.0

    # control by the navigator

    def activate(self, way: Way = Way.NORMAL) -> bool:
        """Start or resume the mission; return whether it has no item left to fly."""
        self._turn(way)
        self._active = self._flown = True
        self.returning = False
        self.reached = -1
        self._stage = _Stage.ITEM
        self._item = None
        if self._view.landed:
            self._need_takeoff = True
        self._payload.pause(False)
        self._wait_here()
        return not self._set_item()

    def _wait_here(self) -> None:
        """Hold until an item names a goal: that of another mode, of its sticks or of a former mission has ended."""
        self._loitering = True
        found = self._read(self._index, count_jumps=False)
        if found is None or found[1].has_position or self._view.landed:
            return
        self._course.hold()

    def deactivate(self) -> None:
        """Pause the mission; the next ``activate`` restarts the current item."""
        if not self._active:
            return
        self._active = False
        self._left_us = self._view.time_us
        self._stage = _Stage.ITEM
        self._landing.stop()
        self._payload.stop_with_mission()

    def require_takeoff(self) -> None:
        """Climb first when the next ``activate`` finds the vehicle below its item, as after a mode without a goal."""
        self._need_takeoff = True

    def _turn(self, way: Way) -> None:
        """Fly the mission in another way; a change of direction skips the current item."""
        last = len(self.plans.mission) - 1
        if way is Way.BACK and self._way is not Way.BACK:
            self.plans.current = max(self.plans.current - 1, 0)
        elif way is not Way.BACK and self._way is Way.BACK and self.plans.current < last:
            self.plans.current += 1
        self._way = way

    def go_on(self, where: Way, *, closest: bool) -> bool:
        """Fly on in the way ``where``, from the closest of its positions if ``closest``; home is one on the way back.

        Returns:
            Whether there is nothing left to fly.
        """
        self._turn(where)
        if closest:
            self.plans.current, self._past_end = self._closest(), False
        return self.activate(where)

    def go_to_landing(self) -> bool:
        """Start or continue the landing that the mission has; return whether there is nothing left to fly."""
        landing = self.landing_item()
        assert landing is not None, "the navigator checks for it"
        self._turn(Way.TO_LANDING)
        self.plans.current, self._past_end = max(self.plans.current, landing[1]), False
        return self.activate(Way.TO_LANDING)

    def _closest(self) -> int:
        """Return the index of the position that is closest to the vehicle; -1 for home, on the way back only."""
        x, y, z = self._view.position
        places = {i: self._locate(item) for i, item in enumerate(self.plans.mission) if item.has_position}
        if self._way is Way.BACK and self._course.home is not None:
            places[-1] = self._course.home.position
        return min(places, key=lambda i: math.dist(places[i], (x, y, z)), default=0)

    @property
    def landing_in_progress(self) -> bool:
        """Whether the mission is in its landing part, or was until two seconds ago."""
        landing = self.landing_item()
        recent = self._active or self._view.time_us - self._left_us <= _LANDING_KEPT_US
        return recent and landing is not None and self.plans.current >= landing[1]

    def reset(self) -> None:
        """Rewind a mission that has been flown to its first item."""
        if self._flown:
            self._flown = self._past_end = False
            self._way = Way.NORMAL
            self.plans.current = 0
            self._jumps.clear()

    def load(self, current: int) -> None:
        """Adopt a changed plan.

        Args:
            current: index of the item to start with; -1 keeps the current index if the plan still has such an item.
        """
        count = len(self.plans.mission)
        index = current if 0 <= current < count else self._index
        self.plans.current = index if index < count else 0
        self._past_end = False
        self.reached = -1
        self._stage = _Stage.ITEM
        self._roi_kind = _ROI_NONE

    def reset_jump_counts(self) -> None:
        """Reset the repetition counts of all DO_JUMP items."""
        self._jumps.clear()

    def restart_item(self) -> bool:
        """Start the current item if the mission is active; return whether an active mission has no item left to fly."""
        if not self._active:
            return False
        self._wait_here()
        return not self._set_item()

    def update(self) -> bool:
        """Advance to the next item when the current one is complete; return whether the mission has ended."""
        if self._item is None:
            return True
        if self._landing.active:
            self._landing.update()
        if self._done():
            if self._stage is not _Stage.TAKEOFF:
                self.reached = self.plans.current
            if self._item.autocontinue or self._stage in (_Stage.TAKEOFF, _Stage.MOVE_TO_LAND):
                if self._stage is _Stage.ITEM or self._stage is _Stage.PRECISION_LAND:
                    self.plans.current = self._following(self.plans.current)
                    self._stage = _Stage.ITEM
                return not self._set_item()
            return False
        self._check_heading_timeout(self._item)
        self._update_heading()
        return False

    def _following(self, index: int) -> int:
        """Return the index of the item after ``index``; on the way back that is a position, -1 after the first one."""
        if self._way is not Way.BACK:
            return index + 1
        items = self.plans.mission
        return next((i for i in range(index - 1, -1, -1) if items[i].has_position), -1)

    def landing_item(self) -> tuple[PlanItem, int] | None:
        """Return the first position of the mission's landing and the index at which the landing begins.

        As in PX4 (``Mission::find_mission_land_start``) that is the position after DO_LAND_START, or the landing item
        of a mission without one. None for a mission with neither.
        """
        items = self.plans.mission
        start = None
        for i, item in enumerate(items[1:], 1):
            if item.command == plan.LAND_START and start is None:
                start = i
            if not item.has_position or not all(map(math.isfinite, (item.x, item.y, item.z))):
                continue
            if start is None and item.command == plan.LAND:
                return item, i
            if start is not None:
                return item, start
        return None

    # access to the items

    @property
    def _index(self) -> int:
        """Index of the item to fly: the current one, or the one after the last."""
        return self.plans.current + self._past_end

    def _read(self, index: int, count_jumps: bool) -> tuple[int, PlanItem] | None:
        """Return index and item at ``index`` after following jumps; None past the end."""
        items = self.plans.mission
        for _ in range(_MAX_JUMPS):
            if not 0 <= index < len(items):
                if items and index not in (len(items), -1):
                    self._tell(
                        CRITICAL,
                        f"Mission item index out of bound, index: {index}, max: {len(items)}.",
                        "mission_index_out_of_bound",
                        index & 0xFFFF,
                        len(items),
                        level=ERROR,
                    )
                return None
            item = items[index]
            if item.command != plan.JUMP:
                return index, self._adapted(item)
            index = self._jump(index, item, count_jumps) if self._way is Way.NORMAL else self._beside(index)
        self._tell(CRITICAL, "DO JUMP is cycling, giving up.", "mission_do_jump_cycle", level=ERROR)
        return None

    def _beside(self, index: int) -> int:
        return index - 1 if self._way is Way.BACK else index + 1

    def _adapted(self, item: PlanItem) -> PlanItem:
        """Return ``item`` as it is flown: without a wait on the way to a landing, as a waypoint on the way back."""
        if self._way is Way.TO_LANDING and item.command == plan.DELAY:
            return replace(item, params=(0.0, *item.params[1:]))
        to_waypoint = self._way is Way.BACK or (self._way is Way.TO_LANDING and item.command in _WAITING)
        if not to_waypoint or not item.has_position:
            return item
        radius = item.params[1] if item.command == plan.WAYPOINT else NAN
        yaw = math.degrees(item.yaw)
        return replace(item, command=plan.WAYPOINT, params=(0.0, radius, NAN, yaw), autocontinue=True)

    def _jump(self, index: int, item: PlanItem, count: bool) -> int:
        done = self._jumps.get(index, 0)
        target, repeats = plan.jump(item.params)
        if done < repeats:
            if count:
                self._jumps[index] = done + 1
            return target
        if count:
            self._tell(INFO, "DO JUMP repetitions completed.", "mission_do_jump_rep_completed")
        return index + 1

    def _next_position(self) -> PlanItem | None:
        """Return the next item with a position, searched as PX4's ``prepare_mission_items`` does.

        A command at which a jump ends does not move the search: it goes on after the jump.
        """
        step, end = (-1, -1) if self._way is Way.BACK else (1, len(self.plans.mission))
        for index in range(self.plans.current + step, end, step):
            found = self._read(index, count_jumps=False)
            if found is None or found[1].has_position:
                return None if found is None else found[1]
        return None

    # current item

    def _set_item(self) -> bool:
        """Start the current item; return False when the mission has ended."""
        found = self._read(self._index, count_jumps=True)
        if found is None:
            self._finish()
            return False
        self.plans.current, item = found
        self._past_end = False
        self._item = item
        self._reached_target = self._reached_heading = False
        self._reached_us = None
        if self._landing.active:
            self._landing.stop()
        if item.has_position:
            self._fly(item)
        else:
            self._issue(item)
        return True

    def _finish(self) -> None:
        flown = self._item is not None or self._way is Way.BACK
        count = len(self.plans.mission)
        self._past_end = self._index >= count > 0
        self.plans.current = max(min(self.plans.current, count - 1), 0)
        self._item = None
        landed = self._view.landed
        if flown:
            outcome, name = ("landed", "mission_finished") if landed else ("loitering", "mission_finished_loiter")
            kind = "Mission"
            if self._way is Way.BACK:
                kind = "Reverse Mission"
                name = "mission_finished_rev" if landed else "mission_finished_rev_loiter"
            self._tell(INFO, f"{kind} finished, {outcome}", name)
        else:
            outcome, name = "loitering", "mission_not_valid_loiter"
            if landed:
                outcome, name = "refusing takeoff", "mission_not_valid_refuse"
            self._tell(CRITICAL, f"No valid mission available, {outcome}", name, level=ERROR)

    def _locate(self, item: PlanItem) -> Vector:
        """Return an item's position, m, local NED, completed by the vehicle's where the item leaves it open."""
        x, y, z = self._view.position
        home = self._course.home
        altitude = item.altitude(NAN if home is None else home.altitude)
        if math.isfinite(item.x) and math.isfinite(item.y):
            x, y, _ = self._view.to_local(item.x, item.y, 0.0)
        if math.isfinite(altitude):
            z = self._view.origin[2] - altitude
        return x, y, z

    def _fly(self, item: PlanItem) -> None:
        position = self._locate(item)
        self._yaw = item.yaw if math.isfinite(item.yaw) else NAN
        back = self._way is Way.BACK
        if self._stage is _Stage.ITEM and not back and self._takeoff_first(item, position):
            self._take_off(position)
            return
        moved = self._stage is _Stage.MOVE_TO_LAND
        if self._stage is _Stage.TAKEOFF:
            self._view.setpoint["climb_speed"] = NAN
        self._stage = _Stage.ITEM
        self._target = position
        self._loitering = item.command in _LOITERS
        if item.command == plan.LAND:
            self._fly_landing(item, position, moved)
            return
        if item.command == plan.TAKEOFF:
            self._yaw = NAN  # the heading mode decides, as in PX4
        if item.command == plan.LOITER_TO_ALT:
            position = self._target = (position[0], position[1], self._view.position[2])
        self._go(position, self._onward(item), self._radius(item))

    def _go(self, position: Vector, onward: Vector, radius: float) -> None:
        self._course.fly_to(position, self._yaw, onward=onward, radius=radius)
        if math.isnan(self._yaw):
            self._course.free_heading()

    def _onward(self, item: PlanItem) -> Vector:
        """Return the position to fly to after ``item`` without stopping, m, local NED; NaN when the vehicle stops.

        It brakes for an item that takes time, with a position or without (PX4 ``set_mission_items``, brake_for_hold).
        """
        brakes = item.time_inside > FLT_EPSILON or item.command in _PAYLOAD_WAITS
        if not item.autocontinue or brakes or self._loitering:
            return UNSET
        following = self._next_position()
        return UNSET if following is None else self._locate(following)

    def _takeoff_first(self, item: PlanItem, position: Vector) -> bool:
        """Return whether the vehicle must climb before it flies to ``item``."""
        height = self._takeoff_height(position)
        if self._view.landed:
            self._need_takeoff = True
        elif self._view.position[2] < height + self._get("NAV_MC_ALT_RAD"):
            self._need_takeoff = False
        elif item.command == plan.TAKEOFF:
            self._need_takeoff = True
        if not self._need_takeoff or item.command not in _NEEDS_TAKEOFF:
            return False
        self._need_takeoff = False
        return True

    def _takeoff_height(self, position: Vector) -> float:
        """Return the z of the takeoff, m, local NED: the item's, at least MIS_TAKEOFF_ALT above the ground."""
        ground = self._view.position[2] if self._view.landed else self._course.ground
        return min(position[2], ground - self._get("MIS_TAKEOFF_ALT"))

    def _take_off(self, position: Vector) -> None:
        self._stage = _Stage.TAKEOFF
        x, y, _ = self._view.position
        height = self._takeoff_height(position)
        over = self._course.ground - height
        self._tell(INFO, f"Takeoff to {over:.1f} meters above home", "mission_takeoff_to", over)
        self._target = (x, y, height)
        self._yaw = self._view.yaw
        self._course.take_off(self._target, self._yaw)

    def _fly_landing(self, item: PlanItem, position: Vector, moved: bool) -> None:
        self._yaw = NAN
        if not moved and self._course.distance_to(position) > self._get("NAV_ACC_RAD"):
            self._stage = _Stage.MOVE_TO_LAND
            self._target = (position[0], position[1], self._current_height())
            self._go(self._target, UNSET, float(self._get("NAV_ACC_RAD")))
        elif item.params[1] in _PRECISE:
            self._stage = _Stage.PRECISION_LAND
            self._landing.start(position, int(item.params[1]))
        else:
            self._course.land(position)
        self._need_takeoff = self._need_takeoff or self._course.landing

    def _current_height(self) -> float:
        """Return the z of the previous goal, m, local NED, or the vehicle's when it is not near that height."""
        z = self._course.goal[2]
        return z if self._course.at_height(z) else self._view.position[2]

    # completion of the current item

    def _done(self) -> bool:
        item = self._item
        assert item is not None
        if self._stage in (_Stage.TAKEOFF, _Stage.MOVE_TO_LAND):
            return self._arrived(item)
        if item.command == plan.LAND:
            return self._view.landed
        if item.command == plan.LOITER_UNLIM:
            return False
        if item.command in _PAYLOAD_WAITS:
            return self._waited(self._get("MIS_PD_TO"))
        if item.command == plan.DELAY:
            return self._waited(item.time_inside)
        if item.command == plan.CONDITION_GATE:
            return self._through_gate(item)
        if not item.has_position:
            return item.command != plan.RETURN
        return self._arrived(item) and self._waited(item.time_inside)

    def _waited(self, seconds: float) -> bool:
        """Return whether ``seconds`` have passed since the current item was reached or first waited for."""
        if self._reached_us is None:
            self._reached_us = self._view.time_us
        return self._view.time_us - self._reached_us >= seconds * 1e6

    def _arrived(self, item: PlanItem) -> bool:
        if self._view.landed:
            return False
        if not self._reached_target and self._near(item):
            self._reached_target = True
            self._reached_us = self._view.time_us
        if self._reached_target and not self._reached_heading:
            self._reached_heading = self._heading_reached()
        return self._reached_target and self._reached_heading

    def _near(self, item: PlanItem) -> bool:
        z = self._view.position[2]
        if self._stage is _Stage.TAKEOFF:
            return z < self._target[2] + self._takeoff_margin()
        if item.command == plan.LOITER_TO_ALT and self._stage is _Stage.ITEM:
            return self._near_loiter_height(item)
        return self._course.distance_to(self._target) <= self._radius(item) and self._course.at_height(self._target[2])

    def _takeoff_margin(self) -> float:
        height = self._course.ground - self._target[2]
        margin = float(self._get("NAV_MC_ALT_RAD"))
        return 0.5 * height if 0.0 < height < margin else margin

    def _near_loiter_height(self, item: PlanItem) -> bool:
        radius = item.params[1]
        if not math.isfinite(radius) or radius == 0.0:
            radius = self._get("NAV_LOITER_RAD")
        if self._course.distance_to(self._target) > self._get("NAV_ACC_RAD") + abs(radius):
            return False
        wanted = self._locate(item)[2]
        if self._target[2] != wanted:  # above the position: change the height next
            self._target = (self._target[0], self._target[1], wanted)
            self._course.fly_to(self._target, self._yaw)
            return False
        return self._course.at_height(wanted)

    def _radius(self, item: PlanItem) -> float:
        """Return the acceptance radius of ``item``, m."""
        given = item.params[1] if item.command == plan.WAYPOINT else NAN
        return given if math.isfinite(given) and given > 0.0 else float(self._get("NAV_ACC_RAD"))

    def _heading_reached(self) -> bool:
        if math.isnan(self._yaw) or self._stage is _Stage.TAKEOFF:
            return True
        assert self._item is not None
        if self._get("MIS_YAW_TMT") > 0.0 and not self._item.forces_heading:
            return True  # a heading timeout waives the check of a heading that the item does not require
        error = math.remainder(self._yaw - self._view.yaw, 2.0 * math.pi)
        return abs(error) < math.radians(self._get("MIS_YAW_ERR"))

    def _check_heading_timeout(self, item: PlanItem) -> None:
        """Return home when a required heading is not reached within MIS_YAW_TMT at the item (PX4's mission failure)."""
        timeout = self._get("MIS_YAW_TMT")
        if self._stage is not _Stage.ITEM or not self._reached_target or self._reached_heading or timeout <= 0.0:
            return
        if item.forces_heading and self._waited(int(timeout)):
            text = "unable to reach heading within timeout"
            self._tell(CRITICAL, text, "navigator_mission_failure_heading")
            self.returning = True

    def _through_gate(self, item: PlanItem) -> bool:
        """Return whether the vehicle has passed the vertical plane through the gate, normal to the line to the goal."""
        gate = self._locate(item)
        goal = self._course.goal
        x, y, _ = self._view.position
        return (x - gate[0]) * (goal[0] - gate[0]) + (y - gate[1]) * (goal[1] - gate[1]) >= 0.0

    # items without a position

    def _issue(self, item: PlanItem) -> None:
        self._stage = _Stage.ITEM
        params = (*item.params, item.x, item.y, item.z)
        if item.command == plan.CONDITION_GATE:
            following = self._next_position()
            if following is not None:
                self._yaw = following.yaw
                self._go(self._locate(following), UNSET, self._radius(following))
            return
        self._course.lead_onward(self._onward(item))
        if item.command == plan.CHANGE_SPEED:
            self._course.set_cruising_speed(params[1], at_once=True)  # of whatever kind
        elif item.command == plan.SET_HOME:
            self.set_home(None if params[0] == 1.0 else params[4:7], math.radians(params[3]))
        elif item.command == plan.RETURN:
            self.returning = True
        elif not self._payload.execute(item.command, params):
            self.set_roi(item)

    def set_roi(self, item: PlanItem) -> None:
        """Set or clear the region of interest of a DO_SET_ROI* item, a location or the next waypoint."""
        if item.command == plan.SET_ROI_LOCATION or (item.command == plan.SET_ROI and item.params[0] == _ROI_LOCATION):
            self._roi_kind, self._roi = _ROI_LOCATION, self._locate(item)
        elif item.command == plan.SET_ROI_NEXT:
            self._roi_kind, self._roi_offset = _ROI_NEXT, math.radians(item.z) if math.isfinite(item.z) else 0.0
        elif item.command == plan.SET_ROI and item.params[0] == _ROI_NEXT:
            self._roi_kind, self._roi_offset = _ROI_NEXT, 0.0
        elif item.command in (plan.SET_ROI_NONE, plan.SET_ROI):
            self._roi_kind = _ROI_NONE
        self._payload.gimbal_manager.look_at(self._roi if self._roi_kind == _ROI_LOCATION else None)

    def _update_heading(self) -> None:
        """Point the vehicle at the region of interest, or follow the heading mode without one."""
        item = self._item
        if self._roi_kind == _ROI_NONE or self._stage is _Stage.TAKEOFF or (item and item.command == plan.LAND):
            self._course.update_heading()
            return
        position = self._course.goal if self._roi_kind == _ROI_NEXT else self._roi
        offset = self._roi_offset if self._roi_kind == _ROI_NEXT else 0.0
        if position is not None and self._course.distance_to(position) > self._get("NAV_ACC_RAD"):
            self._yaw = self._course.bearing_to(position) + offset
            self._course.look(self._yaw)
