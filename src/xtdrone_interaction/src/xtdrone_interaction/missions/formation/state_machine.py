"""The formation flight as a mission: a sequence of commands in simulated time, without ROS.

The mission reads a :class:`FleetState`, which its caller keeps up to date, and acts through :class:`Commands`. It is a
generator that is advanced once a tick, so that its code is in the order of the flight.

A follower that fails in the air is *lost*: an event names it, and the flight continues without waiting for it. A
vehicle that has left OFFBOARD, for example because its communication node has died, is in PX4's failsafe; one whose
follower node has died hovers and lands with the others. Without its leader the flight has failed.

Positions are ENU in the ``map`` frame, metres; index 0 is the leader.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from xtdrone_interaction.missions.formation.criteria import SETTLED_ERROR
from xtdrone_interaction.recording.distances import Array, formation_error
from xtdrone_interaction.recording.topics import ORIGIN

Ticks = Iterator[None]

SETTLED_HOLD = 5.0  # s; time that all must stay in their slots, until the approach has decayed
SETTLE_LIMIT = 60.0  # s
CLEARANCE = 3.0  # m between the ground and any pattern's lowest slot
CLIMB_SPEED = 1.0  # m/s, of the leader; followers fly at most 1 m/s, without feed-forward
MOVE_SPEED = 0.5  # m/s
MOVE_DISTANCE = 4.0  # m, flown by the leader between two patterns
LANDING_HEIGHT = 2.5  # m, the leader's height before landing
_REPEAT = 1.0  # s until a command without effect is repeated
_LEADER_GAIN = 1.0  # 1/s
_ARRIVED = 0.1  # m
_TAKEOFF_HEIGHT = 1.0  # m; AUTO.TAKEOFF ends in AUTO.LOITER well above it
_SAME_SLOT = 1e-3  # m; offsets travel as 32-bit floats
_HOVER_TIME = 0.5  # s of setpoints before OFFBOARD is requested
COMMAND_LIMIT = 5.0  # s without commands of a follower that sent some before
PATTERN_LIMIT = 5.0  # s without a pattern of a leader that repeats it once a second
_LIMITS = {"connect": 60.0, "arm": 40.0, "takeoff": 40.0, "offboard": 15.0, "pattern": 10.0, "land": 90.0}  # s


class MissionError(RuntimeError):
    """The flight cannot continue."""


class Commands(Protocol):
    """The commands of a mission to the fleet."""

    def vehicle(self, index: int, command: str) -> None:
        """Send an XTDrone command (ARM, OFFBOARD, AUTO.LAND, ...) to one vehicle."""

    def leader(self, command: str) -> None:
        """Send a command, such as the name of a pattern, to the leader node."""

    def leader_velocity(self, velocity: Array) -> None:
        """Command the leader's velocity, shape (3,), m/s FLU."""

    def event(self, event: str, **values: Any) -> None:
        """Record an event at the current time."""


@dataclass
class FleetState:
    """The state of the fleet.

    Attributes:
        names: vehicles, the leader first.
        time: simulated time, s.
        position: shape (n, 3), m ENU; NaN while unknown.
        connected: whether MAVROS is connected to the autopilot, per vehicle.
        armed: per vehicle.
        mode: PX4's mode by its MAVROS name, per vehicle.
        leader_yaw: rad from east, counter-clockwise.
        offsets: assigned offsets from the leader, shape (n - 1, 3), m, None before the first pattern.
        commanded: time of the last command of each vehicle's follower, s; None if unknown.
        pattern_time: time of the leader's last pattern message, s; None if unknown.
    """

    names: Sequence[str]
    time: float = 0.0
    position: Array = field(init=False)
    connected: list[bool] = field(init=False)
    armed: list[bool] = field(init=False)
    mode: list[str] = field(init=False)
    leader_yaw: float = 0.0
    offsets: Array | None = None
    commanded: list[float | None] = field(init=False)
    pattern_time: float | None = None

    def __post_init__(self) -> None:
        """Set every vehicle to unknown."""
        count = len(self.names)
        self.position = np.full((count, 3), np.nan)
        self.connected = [False] * count
        self.armed = [False] * count
        self.mode = [""] * count
        self.commanded = [None] * count

    def error(self) -> Array | None:
        """Return the followers' distances from their slots, shape (n - 1,), m; None before the first pattern."""
        if self.offsets is None or len(self.offsets) != len(self.names) - 1:
            return None
        return formation_error(self.position, self.offsets)


class FormationMission:
    """Takeoff, the patterns in turn, landing.

    Attributes:
        phase: the current phase.
        step: its number, from 1.
        steps: number of phases.
        unsettled: patterns that did not settle in time.
        lost: numbers of the failed followers, with the reasons.
    """

    def __init__(
        self,
        fleet: FleetState,
        commands: Commands,
        patterns: Sequence[str],
        slots: Mapping[str, Array],
        clearance: float = CLEARANCE,
        settle_limit: float = SETTLE_LIMIT,
    ) -> None:
        """Plan the flight.

        Args:
            fleet: kept up to date by the caller.
            commands: sent to the fleet.
            patterns: flown in turn; ``origin`` is flown before and after them.
            slots: offsets of each pattern and of ``origin``, shape (n - 1, 3), m.
            clearance: minimum height of any slot above the ground, m.
            settle_limit: s; a pattern that has not settled by then is skipped.
        """
        self.fleet = fleet
        self.commands = commands
        self.patterns = list(patterns)
        self.slots = slots
        self.height = clearance + max(0.0, *(-float(slots[p][:, 2].min()) for p in self.patterns))
        self.phase = ""
        self.step = 0
        self.steps = 8 + len(self.patterns) + max(0, len(self.patterns) - 1)
        self.unsettled: list[str] = []
        self.lost: dict[int, str] = {}
        self._away: set[int] = set()  # lost vehicles that do not respond to commands
        self._ground = 0.0
        self._settle_limit = settle_limit

    def fly(self) -> Ticks:
        """Fly the mission; advance once a tick.

        Raises:
            MissionError: a vehicle did not connect, arm or take off in time, or the leader or all followers have
                failed in the air.
        """
        yield from self._connect()
        yield from self._take_off()
        yield from self._offboard()
        yield from self._form(ORIGIN)
        self._begin("climb")
        yield from self._move_to(height=self.height, speed=CLIMB_SPEED)
        yield from self._settle("climb")
        for number, pattern in enumerate(self.patterns):
            if number:
                self._begin("move")
                yield from self._move_to(forward=MOVE_DISTANCE, speed=MOVE_SPEED)
                yield from self._settle("move")
            yield from self._form(pattern)
        yield from self._form(ORIGIN)
        self._begin("descend")
        yield from self._move_to(height=LANDING_HEIGHT, speed=CLIMB_SPEED)
        yield from self._settle("descend")
        self._begin("land")
        yield from self.land()

    def land(self) -> Ticks:
        """Land all vehicles in place, and wait until all that respond are disarmed.

        Raises:
            MissionError: the leader is still armed after the limit.
        """
        armed = self.fleet.armed
        yield from self._until(
            "land and disarm", _LIMITS["land"], lambda i: not armed[i], self._mode_command("AUTO.LAND"), in_flight=True
        )

    @property
    def result(self) -> dict[str, Any]:
        """Content of the last event of a completed flight: patterns that did not settle, and lost vehicles."""
        names = [self.fleet.names[index] for index in sorted(self.lost)]
        return {"unsettled": self.unsettled, **({"lost": names} if names else {})}

    def error(self) -> Array | None:
        """Return the followers' distances from their slots, (n - 1,), m; 0 for lost ones; None without slots."""
        error = self.fleet.error()
        if error is not None and self.lost:
            error[[index - 1 for index in self.lost]] = 0.0
        return error

    def _connect(self) -> Ticks:
        self._begin("connect")
        fleet = self.fleet
        yield from self._until(
            "connect and report a position",
            _LIMITS["connect"],
            lambda i: fleet.connected[i] and bool(np.isfinite(fleet.position[i]).all()),
        )
        self._ground = float(fleet.position[:, 2].min())

    def _take_off(self) -> Ticks:
        self._begin("takeoff", vehicles=list(self.fleet.names))
        fleet = self.fleet
        taking_off = ("AUTO.TAKEOFF", "AUTO.LOITER")
        yield from self._until(
            "switch to AUTO.TAKEOFF",
            _LIMITS["offboard"],
            lambda i: fleet.mode[i] in taking_off[:1],
            self._mode_command("AUTO.TAKEOFF"),
        )
        yield from self._until("arm", _LIMITS["arm"], lambda i: fleet.armed[i], self._arm)
        self.commands.event("armed")
        yield from self._until(
            "reach the takeoff height",
            _LIMITS["takeoff"],
            lambda i: fleet.mode[i] == "AUTO.LOITER" and fleet.position[i, 2] > self._ground + _TAKEOFF_HEIGHT,
            in_flight=True,
        )

    def _arm(self, index: int) -> None:
        """Arm a vehicle, after AUTO.TAKEOFF if it has rejected or left that mode in the meantime."""
        if self.fleet.mode[index] != "AUTO.TAKEOFF":
            self.commands.vehicle(index, "AUTO.TAKEOFF")
        self.commands.vehicle(index, "ARM")

    def _offboard(self) -> Ticks:
        self._begin("offboard")
        for i in range(len(self.fleet.names)):
            self.commands.vehicle(i, "HOVER")  # setpoints must stream before OFFBOARD is accepted
        yield from self._wait(_HOVER_TIME)
        mode = self.fleet.mode
        yield from self._until(
            "switch to OFFBOARD",
            _LIMITS["offboard"],
            lambda i: mode[i] == "OFFBOARD",
            self._mode_command("OFFBOARD"),
            in_flight=True,
        )

    def _form(self, pattern: str) -> Ticks:
        """Command a pattern and wait until all followers are in their slots."""
        self._begin(f"pattern {pattern}", pattern=pattern)
        start = due = self.fleet.time
        while not self._assigned(pattern):
            self._check_flying()
            if self.fleet.time - start > _LIMITS["pattern"]:
                raise MissionError(f"leader: no offsets of pattern {pattern!r} within {_LIMITS['pattern']:.0f} s")
            if self.fleet.time >= due:
                self.commands.leader(pattern)
                due = self.fleet.time + _REPEAT
            yield
        assert self.fleet.offsets is not None
        self.commands.event("assigned", pattern=pattern, offsets=self.fleet.offsets.round(4).tolist())
        yield from self._settle(pattern)

    def _assigned(self, pattern: str) -> bool:
        """Return whether the leader's offsets are the pattern's slots in any order."""
        offsets, slots = self.fleet.offsets, self.slots[pattern]
        if offsets is None or offsets.shape != slots.shape:
            return False
        return _all_near(offsets, slots) and _all_near(slots, offsets)

    def _settle(self, what: str) -> Ticks:
        """Wait until all followers have been in their slots for SETTLED_HOLD; register a timeout as unsettled."""
        start = self.fleet.time
        inside: float | None = None
        while self.fleet.time - start < self._settle_limit:
            self._check_flying()
            error = self.error()
            if error is None or error.max() > SETTLED_ERROR:
                inside = None
            elif inside is None:
                inside = self.fleet.time
            if inside is not None and self.fleet.time - inside >= SETTLED_HOLD:
                self.commands.event("settled", what=what, after=inside - start)
                return
            yield
        self.unsettled.append(what)
        error = self.error()
        worst = int(error.argmax()) + 1 if error is not None else 0
        self.commands.event(
            "unsettled",
            what=what,
            vehicle=self.fleet.names[worst],
            error=float(error.max()) if error is not None else None,
        )

    def _move_to(self, speed: float, height: float | None = None, forward: float = 0.0) -> Ticks:
        """Fly the leader ``forward`` m along its heading and to ``height`` m above the ground, at most at ``speed``."""
        fleet = self.fleet
        heading = np.array([math.cos(fleet.leader_yaw), math.sin(fleet.leader_yaw), 0.0])
        goal = fleet.position[0] + forward * heading
        if height is not None:
            goal[2] = self._ground + height
        start, limit = fleet.time, 10.0 + 3.0 * float(np.linalg.norm(goal - fleet.position[0])) / speed
        while np.linalg.norm(goal - fleet.position[0]) > _ARRIVED:
            self._check_flying()
            if fleet.time - start > limit:
                raise MissionError(f"leader {fleet.names[0]}: did not reach its goal within {limit:.0f} s")
            velocity = _LEADER_GAIN * (goal - fleet.position[0])
            velocity *= min(1.0, speed / float(np.linalg.norm(velocity)))
            self.commands.leader_velocity(_enu_to_flu(velocity, fleet.leader_yaw))
            yield
        self.commands.leader_velocity(np.zeros(3))

    def _check_flying(self) -> None:
        """Find vehicles that have failed since the last tick.

        Raises:
            MissionError: the leader has failed, or no follower is left.
        """
        fleet = self.fleet
        for i, (armed, mode) in enumerate(zip(fleet.armed, fleet.mode, strict=True)):
            if i in self._away:
                continue
            if not armed or mode != "OFFBOARD":
                state = "armed" if armed else "disarmed"
                self._away.add(i)
                self._lose(i, f"is {state} in mode {mode!r}; armed in OFFBOARD is needed")
            elif i not in self.lost and _silent(fleet.commanded[i], fleet.time, COMMAND_LIMIT):
                self._lose(i, f"no command of its follower for {COMMAND_LIMIT:g} s")
        if _silent(fleet.pattern_time, fleet.time, PATTERN_LIMIT):
            raise MissionError(f"leader: its node has published no pattern for {PATTERN_LIMIT:g} s")

    def _lose(self, index: int, reason: str) -> None:
        """Continue without a follower, which failed for ``reason``.

        Raises:
            MissionError: it is the leader or the last follower.
        """
        name = self.fleet.names[index]
        if index == 0:
            raise MissionError(f"leader {name}: {reason}")
        if index not in self.lost:
            self.lost[index] = reason
            self.commands.event("lost", vehicle=name, reason=reason)
        if len(self.lost) == len(self.fleet.names) - 1:
            raise MissionError(f"no follower is left; the last, {name}: {reason}")

    def _begin(self, phase: str, **values: Any) -> None:
        self.phase = phase
        self.step += 1
        self.commands.event("phase", phase=phase, **values)

    def _mode_command(self, command: str) -> Callable[[int], None]:
        return lambda index: self.commands.vehicle(index, command)

    def _until(
        self,
        what: str,
        limit: float,
        reached: Callable[[int], bool],
        command: Callable[[int], None] | None = None,
        *,
        in_flight: bool = False,
    ) -> Ticks:
        """Wait until every responding vehicle has ``reached`` the state; repeat the command to the others.

        Raises:
            MissionError: some have not reached it after ``limit`` s. In flight, followers that have not are lost, and
                only the leader or the last follower raises.
        """
        start = due = self.fleet.time
        while True:
            missing = [i for i in range(len(self.fleet.names)) if not reached(i)]
            waited_for = [i for i in missing if i not in self._away]
            if not waited_for:
                return
            if self.fleet.time - start > limit:
                failure = f"did not {what} within {limit:.0f} s"
                if not in_flight:
                    raise MissionError(f"{', '.join(map(self._state, waited_for))}: {failure}")
                self._away |= set(waited_for) - {0}
                for i in waited_for:
                    self._lose(i, f"{self._state(i)} {failure}")
                return
            if command is not None and self.fleet.time >= due:
                for i in missing:
                    command(i)
                due = self.fleet.time + _REPEAT
            yield

    def _state(self, index: int) -> str:
        armed, mode = self.fleet.armed[index], self.fleet.mode[index]
        return f"{self.fleet.names[index]} ({'armed' if armed else 'disarmed'}, mode {mode or 'unknown'!r})"

    def _wait(self, duration: float) -> Ticks:
        end = self.fleet.time + duration
        while self.fleet.time < end:
            yield


def _silent(last: float | None, now: float, limit: float) -> bool:
    """Return whether messages have stopped for ``limit`` s since ``last``; not if there never were any (None)."""
    return last is not None and now - last > limit


def _all_near(points: Array, others: Array) -> bool:
    """Return whether every point coincides with one of the others; row by row, to save memory in large swarms."""
    return all(np.abs(others - point).max(axis=1).min() < _SAME_SLOT for point in points)


def _enu_to_flu(vector: Array, yaw: float) -> Array:
    """Rotate a vector from ENU to FLU of a level vehicle at heading ``yaw``, rad from east."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1], vector[2]])
