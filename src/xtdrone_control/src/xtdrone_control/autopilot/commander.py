"""Arming, flight modes, failsafes and home of one vehicle, as PX4 v1.14's commander.

All times are simulated. ``update`` is called at about 10 Hz; commands and set-points act at once. Texts for the
operator wait in ``texts`` until a link takes them.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from xtdrone_control.fleet import Vehicle

from . import modes
from .inputs import OffboardInput, StickInput
from .modes import Mode
from .navigator import Home, Navigator
from .parameters import Parameters
from .state import TASK_DESCEND, TASK_IDLE, TASK_STICKS, TASK_TRAJECTORY
from .vehicle_view import Vector, VehicleView

if TYPE_CHECKING:
    from .autopilot import Autopilot

CRITICAL, WARNING, INFO = 2, 4, 6  # MAV_SEVERITY
_NAN = math.nan
_UNSET = (_NAN, _NAN, _NAN)
_NEVER_US = -(1 << 60)
_MAX_TEXTS = 64
_WARNING_INTERVAL_US = 1_000_000

_CUSTOM_MODE_FLAG = 1  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_STANDBY, _ACTIVE, _CRITICAL_STATE, _UNINIT = 3, 4, 5, 0  # MAV_STATE
_ON_GROUND, _IN_AIR, _TAKEOFF, _LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE


class Result(enum.IntEnum):
    """MAV_RESULT: what a command's acknowledgement says."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Failsafe(enum.Enum):
    """Why the vehicle does not fly the mode that it was told to."""

    NONE = ""
    POSITION_LOST = "no valid position"
    OFFBOARD_LOST = "no offboard set-points"
    GCS_LOST = "no ground station"


class Commander:
    """The state machine of one vehicle.

    Attributes:
        vehicle: which vehicle.
        parameters: its parameters.
        navigator: its AUTO modes.
        armed: whether motors run.
        failsafe: what has taken the vehicle out of its mode, ``Failsafe.NONE`` when nothing has.
        texts: (MAV_SEVERITY, text) that no link has taken yet; the oldest are dropped beyond 64.
        on_text: called with every such text, when it is not None: the logger.
    """

    def __init__(self, vehicle: Vehicle, autopilot: Autopilot, parameters: Parameters, index: int) -> None:
        """Start disarmed in AUTO.LOITER.

        Args:
            vehicle: which vehicle.
            autopilot: holder of the records.
            parameters: the vehicle's parameters; they are written into the autopilot's record.
            index: place in the records.
        """
        self.vehicle = vehicle
        self.parameters = parameters
        self.view = VehicleView(autopilot, index)
        self.texts: deque[tuple[int, str]] = deque(maxlen=_MAX_TEXTS)
        self.on_text: Callable[[int, str], None] | None = None
        self.navigator = Navigator(self.view, parameters, self.say)
        self.armed = False
        self.failsafe = Failsafe.NONE
        self._mode = modes.AUTO_LOITER  # what was asked for
        self._failsafe_mode: Mode | None = None
        self._offboard = OffboardInput(self.view)
        self._sticks = StickInput(self.view)
        self._armed_us = 0
        self._took_off = False
        self._was_landed = True
        self._landed_us = 0
        self._position_lost_us: int | None = None
        self._gcs_us: int | None = None
        self._gcs_lost = False
        self._last_warning_us = _NEVER_US
        parameters.write_to(autopilot.params[index])

    # what the heartbeat and its like say

    @property
    def mode(self) -> Mode:
        """The mode that is flown: the failsafe's while there is one."""
        return self._failsafe_mode or self._mode

    @property
    def requested_mode(self) -> Mode:
        """The mode that was asked for, whatever a failsafe has made of it."""
        return self._mode

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode."""
        return self.mode.flags | (modes.ARMED_FLAG if self.armed else 0)

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self.mode.custom_mode

    @property
    def system_status(self) -> int:
        """HEARTBEAT.system_status: a MAV_STATE."""
        if not self.view.initialised:
            return _UNINIT
        if not self.armed:
            return _STANDBY
        return _ACTIVE if self.failsafe is Failsafe.NONE else _CRITICAL_STATE

    @property
    def landed_state(self) -> int:
        """EXTENDED_SYS_STATE.landed_state: a MAV_LANDED_STATE."""
        if self.view.landed:
            return _ON_GROUND
        if self.navigator.landing or self.mode is modes.DESCEND:
            return _LANDING
        return _TAKEOFF if self.mode is modes.AUTO_TAKEOFF else _IN_AIR

    @property
    def ready_to_arm(self) -> bool:
        """Whether arming would be accepted in the present mode."""
        return not self.armed and not self._arming_obstacle()

    @property
    def home(self) -> Home | None:
        """Where AUTO.RTL goes to."""
        return self.navigator.home

    def say(self, severity: int, text: str) -> None:
        """Queue a text for the operator (``severity``: MAV_SEVERITY)."""
        self.texts.append((severity, text))
        if self.on_text is not None:
            self.on_text(severity, text)

    def warn(self, text: str) -> None:
        """Queue a warning, at most one a second."""
        if self.view.time_us - self._last_warning_us >= _WARNING_INTERVAL_US:
            self._last_warning_us = self.view.time_us
            self.say(WARNING, text)

    # arming

    def arm_disarm(self, arm: bool, force: bool = False) -> Result:
        """Arm or disarm; ``force`` passes over the checks, even in the air."""
        if not arm:
            return self._disarm_by_command(force)
        if self.armed:
            return Result.ACCEPTED
        obstacle = self._arming_obstacle()
        if obstacle and not (force and self.view.initialised):
            self.say(CRITICAL, f"Arming denied: {obstacle}")
            return Result.TEMPORARILY_REJECTED
        self._arm()
        return Result.ACCEPTED

    def _arming_obstacle(self) -> str:
        """Return why the vehicle may not be armed now, or an empty text."""
        if not self.view.initialised:
            return "estimator is not ready"
        if not self.view.landed:
            return "vehicle is in the air"
        if self._mode in (modes.AUTO_LAND, modes.AUTO_RTL):
            return f"{self._mode.name} is not for arming"
        if self._mode is modes.POSCTL and not self._sticks.fresh(self.parameters.get("COM_RC_LOSS_T")):
            return "no manual control input"
        return self._mode_obstacle(self._mode)

    def _arm(self) -> None:
        self.armed = True
        self._armed_us = self.view.time_us
        self._took_off = False
        self._was_landed = self.view.landed
        if self.view.position_valid:
            self._set_home_here()
        self.view.setpoint["armed"] = 1
        self.say(INFO, "Armed by external command")
        self._fly(self._mode)

    def _disarm_by_command(self, force: bool) -> Result:
        if not self.armed:
            return Result.ACCEPTED
        if not self.view.landed and not force:
            self.say(CRITICAL, "Disarming denied! Not landed")
            return Result.TEMPORARILY_REJECTED
        self._disarm("Disarmed by external command")
        return Result.ACCEPTED

    def _disarm(self, text: str) -> None:
        self.armed = False
        self.view.setpoint["armed"] = 0
        self.navigator.deactivate()
        self.view.start_task(TASK_IDLE)
        if self._mode.main == modes.MAIN_AUTO or self.failsafe is not Failsafe.NONE:
            self._mode = modes.AUTO_LOITER  # so that the next arming does not land or return
        self.failsafe = Failsafe.NONE
        self._failsafe_mode = None
        self.say(INFO, text)

    # modes

    def set_mode(self, base_mode: int, custom_mode: int) -> Result:
        """Go to the mode of PX4's ``custom_mode``, if ``base_mode`` says that it is one."""
        mode = modes.from_custom_mode(custom_mode) if base_mode & _CUSTOM_MODE_FLAG else None
        if mode is None:
            auto = custom_mode >> 16 & 0xFF == modes.MAIN_AUTO
            self.say(CRITICAL, "Unsupported auto mode" if auto else "Unsupported mode")
            return Result.TEMPORARILY_REJECTED
        if mode not in modes.SUPPORTED:
            allowed = ", ".join(m.name for m in modes.SUPPORTED)
            self.say(CRITICAL, f"{mode.name} is not supported; allowed: {allowed}")
            return Result.UNSUPPORTED
        return self.request(mode)

    def request(self, mode: Mode) -> Result:
        """Go to a supported mode, unless it cannot be flown now."""
        if mode is self._mode and self.failsafe is Failsafe.NONE:
            return Result.ACCEPTED
        obstacle = self._mode_obstacle(mode) if self.armed else ""
        if obstacle:
            self.say(CRITICAL, f"Switching to {mode.name} is currently not available")
            self.say(INFO, f"{mode.name}: {obstacle}")
            return Result.TEMPORARILY_REJECTED
        self._mode = mode
        self.failsafe = Failsafe.NONE
        self._failsafe_mode = None
        if self.armed:
            if mode is modes.AUTO_RTL:
                self.say(INFO, "RTL HOME activated")
            self._fly(mode)
        return Result.ACCEPTED

    def _mode_obstacle(self, mode: Mode) -> str:
        """Return why ``mode`` cannot be flown now, or an empty text."""
        if mode is modes.OFFBOARD and not self._offboard.fresh(self.parameters.get("COM_OF_LOSS_T")):
            return "no offboard signal, send set-points first"
        if self._needs_position(mode) and not self.view.position_valid:
            return "no valid position estimate"
        if mode is modes.AUTO_RTL and self.home is None:
            return "no home position"
        return self.navigator.mission_obstacle() if mode is modes.AUTO_MISSION else ""

    def _needs_position(self, mode: Mode) -> bool:
        return mode.needs_position and (mode is not modes.OFFBOARD or self._offboard.needs_position)

    def _fly(self, mode: Mode) -> None:
        """Let the cascade follow ``mode``; the vehicle is armed."""
        if mode.main == modes.MAIN_AUTO and mode is not modes.DESCEND:
            self.navigator.activate(mode)
            return
        self.navigator.deactivate()
        if mode is modes.OFFBOARD:
            self._offboard.write()
        elif mode is modes.POSCTL:
            self._write_sticks()
            self.view.start_task(TASK_STICKS)
        else:
            self.view.start_task(TASK_DESCEND)

    # steering from outside

    def offboard_trajectory(
        self, position: Vector, velocity: Vector, acceleration: Vector, yaw: float, yaw_rate: float
    ) -> None:
        """Take a trajectory set-point of the OFFBOARD stream: local NED, NaN is not controlled.

        It feeds the stream's watchdog in every mode and is flown in OFFBOARD.

        Raises:
            SetpointError: see ``OffboardInput.set_trajectory``.
        """
        self._offboard.set_trajectory(position, velocity, acceleration, yaw, yaw_rate)
        self._follow_offboard()

    def offboard_attitude(self, attitude: Sequence[float], yaw_rate: float, thrust: float) -> None:
        """Take an attitude set-point of the OFFBOARD stream.

        Raises:
            SetpointError: see ``OffboardInput.set_attitude``.
        """
        self._offboard.set_attitude(attitude, yaw_rate, thrust)
        self._follow_offboard()

    def offboard_rates(self, rates: Sequence[float], thrust: float) -> None:
        """Take a body-rate set-point of the OFFBOARD stream.

        Raises:
            SetpointError: see ``OffboardInput.set_rates``.
        """
        self._offboard.set_rates(rates, thrust)
        self._follow_offboard()

    def _follow_offboard(self) -> None:
        if self.armed and self.mode is modes.OFFBOARD:
            self._offboard.write()

    def manual_control(self, x: float, y: float, z: float, yaw: float) -> None:
        """Take sticks, each -1..1: forward, right, up (0 holds), clockwise; they are flown in POSCTL.

        Raises:
            SetpointError: a value that is not finite.
        """
        self._sticks.set(x, y, z, yaw)
        if self.view.setpoint["task"] == TASK_STICKS:
            self._write_sticks()

    def _write_sticks(self) -> None:
        get = self.parameters.get
        expos = (get("MPC_XY_MAN_EXPO"), get("MPC_Z_MAN_EXPO"), get("MPC_YAW_EXPO"))
        self._sticks.write(get("COM_RC_LOSS_T"), get("MPC_HOLD_DZ"), expos)

    def gcs_heartbeat(self) -> None:
        """Note that a ground station is there."""
        self._gcs_us = self.view.time_us

    # commands

    def takeoff(self, altitude: float, yaw: float) -> Result:
        """Go to AUTO.TAKEOFF.

        Args:
            altitude: m AMSL; NaN for MIS_TAKEOFF_ALT over home.
            yaw: rad; NaN keeps the heading.
        """
        if math.isinf(altitude) or math.isinf(yaw):
            return Result.DENIED
        self.navigator.takeoff_altitude = altitude
        self.navigator.takeoff_yaw = yaw
        return self.request(modes.AUTO_TAKEOFF)

    def land(self) -> Result:
        """Go to AUTO.LAND."""
        result = self.request(modes.AUTO_LAND)
        if result is Result.ACCEPTED:
            self.say(INFO, "Landing at current position")
        return result

    def return_to_launch(self) -> Result:
        """Go to AUTO.RTL."""
        result = self.request(modes.AUTO_RTL)
        if result is Result.ACCEPTED:
            self.say(INFO, "Returning to launch")
        return result

    def set_home(self, place: Vector | None) -> Result:
        """Set home to (latitude, longitude, altitude), degrees and m AMSL, or to where the vehicle is (None)."""
        if place is None:
            if not self.view.position_valid:
                return Result.TEMPORARILY_REJECTED
            self._set_home_here()
            return Result.ACCEPTED
        if not _is_place(*place):
            return Result.DENIED
        if not self.view.position_valid:
            return Result.TEMPORARILY_REJECTED
        position = self.view.to_local(*place)
        self.navigator.home = Home(*place, position, self.view.yaw, self.view.time_us)
        return Result.ACCEPTED

    def _set_home_here(self) -> None:
        position = self.view.position
        place = self.view.to_global(position)
        self.navigator.home = Home(*place, position, self.view.yaw, self.view.time_us)

    def reposition(self, place: Vector, yaw: float, speed: float) -> Result:
        """Fly to a place in AUTO.LOITER.

        Args:
            place: latitude and longitude in degrees, m AMSL; NaN keeps the present one.
            yaw: rad; NaN looks where it flies.
            speed: m/s; NaN or not positive: MPC_XY_CRUISE.
        """
        here = self.view.to_global(self.view.position)
        target = tuple(h if math.isnan(p) else p for p, h in zip(place, here, strict=True))
        if not _is_place(*target) or math.isinf(yaw) or math.isinf(speed):
            return Result.DENIED
        if not self.armed or self.view.landed or self.request(modes.AUTO_LOITER) is not Result.ACCEPTED:
            self.say(CRITICAL, "Reposition command rejected")
            return Result.TEMPORARILY_REJECTED
        if speed > 0.0:
            self.navigator.set_speed("cruise_speed", speed)
        self.navigator.reposition(self.view.to_local(*target), yaw)
        return Result.ACCEPTED

    def change_altitude(self, altitude: float) -> Result:
        """Climb or sink to ``altitude`` (m AMSL) in AUTO.LOITER."""
        if not math.isfinite(altitude):
            return Result.DENIED
        if not self.armed or self.view.landed or self.request(modes.AUTO_LOITER) is not Result.ACCEPTED:
            return Result.TEMPORARILY_REJECTED
        self.navigator.change_altitude(self.view.origin[2] - altitude)
        return Result.ACCEPTED

    def change_speed(self, kind: int, speed: float) -> Result:
        """Set the speed of AUTO modes until the next mode.

        Args:
            kind: SPEED_TYPE: 0 and 1 horizontal, 2 climbing, 3 sinking.
            speed: m/s; -1 leaves it, other negative values go back to the parameter's.
        """
        field = {0: "cruise_speed", 1: "cruise_speed", 2: "climb_speed", 3: "descend_speed"}.get(kind)
        if field is None or not math.isfinite(speed):
            return Result.DENIED
        if speed != -1.0:
            self.navigator.set_speed(field, speed if speed > 0.0 else _NAN)
        return Result.ACCEPTED

    # what goes on by itself

    def update(self) -> None:
        """Look at landing, failsafes and the AUTO modes' progress; call at about 10 Hz."""
        view = self.view
        if not self.armed:
            if self.home is None and view.position_valid:
                self._set_home_here()
            return
        landed = view.landed
        if landed != self._was_landed:
            self._note_landing(landed)
        if landed and self._auto_disarm():
            return
        self._update_failsafe()
        if view.setpoint["task"] == TASK_STICKS:
            self._write_sticks()
        following = self.navigator.update()
        if following is not None:
            self._mode = following
            self.navigator.activate(following)

    def _note_landing(self, landed: bool) -> None:
        self._was_landed = landed
        self._took_off = True
        self._landed_us = self.view.time_us
        self.say(INFO, "Landing detected" if landed else "Takeoff detected")

    def _auto_disarm(self) -> bool:
        now = self.view.time_us
        if self._took_off:
            delay = self.parameters.get("COM_DISARM_LAND")
            if delay > 0.0 and now - self._landed_us >= delay * 1e6:
                self._disarm("Disarmed by landing")
                return True
            return False
        delay = self.parameters.get("COM_DISARM_PRFLT")
        if delay > 0.0 and now - self._armed_us >= delay * 1e6:
            self._disarm("Disarmed by auto preflight disarming")
            return True
        return False

    # failsafes

    def _update_failsafe(self) -> None:
        self._watch_gcs()
        reason = self._present_failsafe()
        if reason is self.failsafe:
            return
        if reason is Failsafe.NONE:
            self.failsafe = reason
            self._failsafe_mode = None
            self.say(INFO, f"Failsafe ended, back to {self._mode.name}")
            self._fly(self._mode)
            return
        self.failsafe = reason
        self.say(CRITICAL, "Failsafe activated")
        self.say(INFO, f"{self._mode.name}: {reason.value}")
        self._act(reason)

    def _present_failsafe(self) -> Failsafe:
        # in PX4 a failsafe that acts because the mode cannot be flown ends when it can, but not on the ground
        if self._position_lost():
            return Failsafe.POSITION_LOST
        get = self.parameters.get
        if self._mode is modes.OFFBOARD:
            if self.failsafe is Failsafe.OFFBOARD_LOST:
                back = self._offboard.steady(get("COM_OF_LOSS_T")) and not self.view.landed
                return Failsafe.NONE if back else self.failsafe
            if not self._offboard.fresh(get("COM_OF_LOSS_T")):
                return Failsafe.OFFBOARD_LOST
        on_its_way_down = self.view.landed or self._mode in (modes.AUTO_LAND, modes.AUTO_RTL)
        if self.failsafe is Failsafe.GCS_LOST or (self._gcs_lost and self._gcs_action() and not on_its_way_down):
            return Failsafe.GCS_LOST
        return Failsafe.NONE

    def _position_lost(self) -> bool:
        if self.view.position_valid or not self._needs_position(self._mode):
            self._position_lost_us = None
            return False
        if self._position_lost_us is None:
            self._position_lost_us = self.view.time_us
        return self.view.time_us - self._position_lost_us >= self.parameters.get("COM_POS_FS_DELAY") * 1e6

    def _act(self, reason: Failsafe) -> None:
        if reason is Failsafe.POSITION_LOST:
            mode = modes.DESCEND
        elif reason is Failsafe.OFFBOARD_LOST:
            actions = {3: modes.AUTO_RTL, 4: modes.AUTO_LAND, 5: modes.AUTO_LOITER}
            mode = actions.get(int(self.parameters.get("COM_OBL_RC_ACT")), modes.POSCTL)
        else:
            mode = self._gcs_action() or modes.AUTO_LOITER
        if mode is modes.AUTO_RTL and self.home is None:
            mode = modes.AUTO_LAND
        self._failsafe_mode = mode
        if mode is modes.POSCTL and not self._sticks.fresh(self.parameters.get("COM_RC_LOSS_T")):
            self._sink()
        else:
            self._fly(mode)

    def _sink(self) -> None:
        """Stop and sink at MPC_LAND_SPEED, keeping the heading: what PX4's POSCTL does when nobody steers."""
        self.navigator.deactivate()
        setpoint = self.view.setpoint
        setpoint["position"] = _UNSET
        setpoint["velocity"] = (0.0, 0.0, self.parameters.get("MPC_LAND_SPEED"))
        setpoint["acceleration"] = _UNSET
        setpoint["yaw"] = setpoint["yaw_rate"] = _NAN
        self.view.start_task(TASK_TRAJECTORY)

    def _watch_gcs(self) -> None:
        if self._gcs_us is None:
            return
        lost = self.view.time_us - self._gcs_us > self.parameters.get("COM_DL_LOSS_T") * 1e6
        if lost != self._gcs_lost:
            self._gcs_lost = lost
            self.say(WARNING if lost else INFO, f"Connection to ground station {'lost' if lost else 'regained'}")

    def _gcs_action(self) -> Mode | None:
        actions = {1: modes.AUTO_LOITER, 2: modes.AUTO_RTL, 3: modes.AUTO_LAND}
        return actions.get(int(self.parameters.get("NAV_DLL_ACT")))


def _is_place(latitude: float, longitude: float, altitude: float) -> bool:
    return abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and math.isfinite(altitude)
