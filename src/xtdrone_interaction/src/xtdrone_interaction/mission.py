"""The formation flight as a mission: what is commanded when, by simulated time alone. No ROS here.

The mission sees the fleet through a :class:`View`, which its caller keeps up to date, and acts through a
:class:`Commands`. It is a generator that is advanced once a tick, so that it reads in the order of the flight.

A follower that fails in the air is *lost*: an event names it, the flight goes on for the others, and nothing waits for
it any more. A vehicle that has left OFFBOARD, as it does when its communication node dies, does what PX4's failsafe
does; one whose follower node has died hovers, and lands with the others. Without its leader there is no formation: then
the flight has failed.

Positions are ENU in the ``map`` frame, metres; index 0 is the leader.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from xtdrone_interaction.geometry import ORIGIN, SETTLED_ERROR, Array, formation_error

Ticks = Iterator[None]

SETTLED_HOLD = 5.0  # s; so long must all stay in their slots: the approach has then died away
SETTLE_LIMIT = 60.0  # s
CLEARANCE = 3.0  # m between the ground and any pattern's lowest slot
CLIMB_SPEED = 1.0  # m/s, of the leader; followers have no feed-forward and 1 m/s themselves
MOVE_SPEED = 0.5  # m/s
MOVE_DISTANCE = 4.0  # m, the leader's way between two patterns
LANDING_HEIGHT = 2.5  # m, the leader's height from which all land
_REPEAT = 1.0  # s until a command without effect is given again
_LEADER_GAIN = 1.0  # 1/s
_ARRIVED = 0.1  # m
_TAKEOFF_HEIGHT = 1.0  # m; AUTO.TAKEOFF ends in AUTO.LOITER well above it
_SAME_SLOT = 1e-3  # m; offsets travel as 32-bit floats
_HOVER_TIME = 0.5  # s of setpoints before OFFBOARD is asked for
COMMAND_LIMIT = 5.0  # s without a command of a follower that has commanded its vehicle before
PATTERN_LIMIT = 5.0  # s without a pattern of a leader that repeats it each second
_LIMITS = {"connect": 60.0, "arm": 40.0, "takeoff": 40.0, "offboard": 15.0, "pattern": 10.0, "land": 90.0}  # s


class MissionError(RuntimeError):
    """The flight cannot go on."""


class Commands(Protocol):
    """What a mission does to the fleet."""

    def vehicle(self, index: int, command: str) -> None:
        """Send an XTDrone command (ARM, OFFBOARD, AUTO.LAND, ...) to one vehicle."""

    def leader(self, command: str) -> None:
        """Send a command, as a pattern's name, to the formation's leader node."""

    def leader_velocity(self, velocity: Array) -> None:
        """Let the leader fly with ``velocity``, shape (3,), m/s FLU."""

    def event(self, event: str, **values: Any) -> None:
        """Record an event at the present time."""


@dataclass
class View:
    """The fleet as the mission sees it.

    Attributes:
        names: vehicles, the leader first.
        time: simulated time, s.
        position: shape (n, 3), m ENU; NaN while unknown.
        connected: whether the autopilot is heard, per vehicle.
        armed: per vehicle.
        mode: PX4's mode as MAVROS names it, per vehicle.
        leader_yaw: rad from east, counter-clockwise.
        offsets: assigned offsets from the leader, shape (n - 1, 3), m, None before the first pattern.
        commanded: when each vehicle's follower has commanded it last, s; None for those of which that is not known.
        pattern_time: when the leader has said its pattern last, s; None where that is not known.
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
        """Know nothing of any vehicle yet."""
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
        phase: the phase now flown.
        step: its number, from 1.
        steps: number of phases.
        unsettled: patterns that did not settle in time.
        lost: numbers of the followers that have failed, with why.
    """

    def __init__(
        self,
        view: View,
        commands: Commands,
        patterns: Sequence[str],
        slots: Mapping[str, Array],
        clearance: float = CLEARANCE,
        settle_limit: float = SETTLE_LIMIT,
    ) -> None:
        """Plan the flight.

        Args:
            view: kept up to date by the caller.
            commands: how to act on the fleet.
            patterns: flown in turn between ``origin`` and ``origin``.
            slots: offsets of each pattern and of ``origin``, shape (n - 1, 3), m.
            clearance: least height of any slot above the ground, m.
            settle_limit: s, after which a pattern that has not settled is given up.
        """
        self.view = view
        self.commands = commands
        self.patterns = list(patterns)
        self.slots = slots
        self.height = clearance + max(0.0, *(-float(slots[p][:, 2].min()) for p in self.patterns))
        self.phase = ""
        self.step = 0
        self.steps = 8 + len(self.patterns) + max(0, len(self.patterns) - 1)
        self.unsettled: list[str] = []
        self.lost: dict[int, str] = {}
        self._away: set[int] = set()  # those of the lost that obey nothing
        self._ground = 0.0
        self._settle_limit = settle_limit

    def fly(self) -> Ticks:
        """Fly the mission; advance once a tick.

        Raises:
            MissionError: a vehicle did not connect, take off or arm within the limit, or the leader or all followers
                have failed in the air.
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
        """Land all vehicles where they are and wait until the last that obeys is disarmed.

        Raises:
            MissionError: the leader is still armed after the limit.
        """
        armed = self.view.armed
        yield from self._until(
            "land and disarm", _LIMITS["land"], lambda i: not armed[i], self._mode_command("AUTO.LAND"), in_flight=True
        )

    @property
    def result(self) -> dict[str, Any]:
        """What the last event of a whole flight says: patterns that did not settle, and vehicles that were lost."""
        names = [self.view.names[index] for index in sorted(self.lost)]
        return {"unsettled": self.unsettled, **({"lost": names} if names else {})}

    def error(self) -> Array | None:
        """Return the followers' distances from their slots, shape (n - 1,), m: 0 for lost ones; None without slots."""
        error = self.view.error()
        if error is not None and self.lost:
            error[[index - 1 for index in self.lost]] = 0.0
        return error

    def _connect(self) -> Ticks:
        self._begin("connect")
        view = self.view
        yield from self._until(
            "connect and report a position",
            _LIMITS["connect"],
            lambda i: view.connected[i] and bool(np.isfinite(view.position[i]).all()),
        )
        self._ground = float(view.position[:, 2].min())

    def _take_off(self) -> Ticks:
        self._begin("takeoff", vehicles=list(self.view.names))
        view = self.view
        taking_off = ("AUTO.TAKEOFF", "AUTO.LOITER")
        yield from self._until(
            "switch to AUTO.TAKEOFF",
            _LIMITS["offboard"],
            lambda i: view.mode[i] in taking_off[:1],
            self._mode_command("AUTO.TAKEOFF"),
        )
        yield from self._until("arm", _LIMITS["arm"], lambda i: view.armed[i], self._arm)
        self.commands.event("armed")
        yield from self._until(
            "reach the takeoff height",
            _LIMITS["takeoff"],
            lambda i: view.mode[i] == "AUTO.LOITER" and view.position[i, 2] > self._ground + _TAKEOFF_HEIGHT,
            in_flight=True,
        )

    def _arm(self, index: int) -> None:
        """Arm; a vehicle may have refused AUTO.TAKEOFF or left it in the meantime, so ask for that again."""
        if self.view.mode[index] != "AUTO.TAKEOFF":
            self.commands.vehicle(index, "AUTO.TAKEOFF")
        self.commands.vehicle(index, "ARM")

    def _offboard(self) -> Ticks:
        self._begin("offboard")
        for i in range(len(self.view.names)):
            self.commands.vehicle(i, "HOVER")  # a setpoint to hold must stream before OFFBOARD is accepted
        yield from self._wait(_HOVER_TIME)
        mode = self.view.mode
        yield from self._until(
            "switch to OFFBOARD",
            _LIMITS["offboard"],
            lambda i: mode[i] == "OFFBOARD",
            self._mode_command("OFFBOARD"),
            in_flight=True,
        )

    def _form(self, pattern: str) -> Ticks:
        """Command a pattern and wait until all are in their slots."""
        self._begin(f"pattern {pattern}", pattern=pattern)
        start = due = self.view.time
        while not self._assigned(pattern):
            self._check_flying()
            if self.view.time - start > _LIMITS["pattern"]:
                raise MissionError(f"leader: no offsets of pattern {pattern!r} within {_LIMITS['pattern']:.0f} s")
            if self.view.time >= due:
                self.commands.leader(pattern)
                due = self.view.time + _REPEAT
            yield
        assert self.view.offsets is not None
        self.commands.event("assigned", pattern=pattern, offsets=self.view.offsets.round(4).tolist())
        yield from self._settle(pattern)

    def _assigned(self, pattern: str) -> bool:
        """Whether the leader's offsets are the pattern's slots in any order."""
        offsets, slots = self.view.offsets, self.slots[pattern]
        if offsets is None or offsets.shape != slots.shape:
            return False
        return _all_near(offsets, slots) and _all_near(slots, offsets)

    def _settle(self, what: str) -> Ticks:
        """Wait until all followers have been in their slots for SETTLED_HOLD; note it when they are not in time."""
        start = self.view.time
        inside: float | None = None
        while self.view.time - start < self._settle_limit:
            self._check_flying()
            error = self.error()
            if error is None or error.max() > SETTLED_ERROR:
                inside = None
            elif inside is None:
                inside = self.view.time
            if inside is not None and self.view.time - inside >= SETTLED_HOLD:
                self.commands.event("settled", what=what, after=inside - start)
                return
            yield
        self.unsettled.append(what)
        error = self.error()
        worst = int(error.argmax()) + 1 if error is not None else 0
        self.commands.event(
            "unsettled",
            what=what,
            vehicle=self.view.names[worst],
            error=float(error.max()) if error is not None else None,
        )

    def _move_to(self, speed: float, height: float | None = None, forward: float = 0.0) -> Ticks:
        """Fly the leader ``forward`` m along its heading and to ``height`` m above the ground, at most at ``speed``."""
        view = self.view
        heading = np.array([math.cos(view.leader_yaw), math.sin(view.leader_yaw), 0.0])
        goal = view.position[0] + forward * heading
        if height is not None:
            goal[2] = self._ground + height
        start, limit = view.time, 10.0 + 3.0 * float(np.linalg.norm(goal - view.position[0])) / speed
        while np.linalg.norm(goal - view.position[0]) > _ARRIVED:
            self._check_flying()
            if view.time - start > limit:
                raise MissionError(f"leader {view.names[0]}: did not reach its goal within {limit:.0f} s")
            velocity = _LEADER_GAIN * (goal - view.position[0])
            velocity *= min(1.0, speed / float(np.linalg.norm(velocity)))
            self.commands.leader_velocity(_enu_to_flu(velocity, view.leader_yaw))
            yield
        self.commands.leader_velocity(np.zeros(3))

    def _check_flying(self) -> None:
        """Look who has failed since the last tick.

        Raises:
            MissionError: the leader has, or no follower is left.
        """
        view = self.view
        for i, (armed, mode) in enumerate(zip(view.armed, view.mode, strict=True)):
            if i in self._away:
                continue
            if not armed or mode != "OFFBOARD":
                state = "armed" if armed else "disarmed"
                self._away.add(i)
                self._lose(i, f"is {state} in mode {mode!r}; armed in OFFBOARD is needed")
            elif i not in self.lost and _silent(view.commanded[i], view.time, COMMAND_LIMIT):
                self._lose(i, f"no command of its follower for {COMMAND_LIMIT:g} s")
        if _silent(view.pattern_time, view.time, PATTERN_LIMIT):
            raise MissionError(f"leader: its node has said no pattern for {PATTERN_LIMIT:g} s")

    def _lose(self, index: int, reason: str) -> None:
        """Go on without a follower; ``reason`` says what became of it.

        Raises:
            MissionError: it is the leader, or the last follower.
        """
        name = self.view.names[index]
        if index == 0:
            raise MissionError(f"leader {name}: {reason}")
        if index not in self.lost:
            self.lost[index] = reason
            self.commands.event("lost", vehicle=name, reason=reason)
        if len(self.lost) == len(self.view.names) - 1:
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
        """Wait until every vehicle that obeys has ``reached`` the state; command those that have not, again and again.

        Raises:
            MissionError: some have not after ``limit`` s. In flight followers that have not are lost, and only the
                leader, or the last follower, is an error.
        """
        start = due = self.view.time
        while True:
            missing = [i for i in range(len(self.view.names)) if not reached(i)]
            waited_for = [i for i in missing if i not in self._away]
            if not waited_for:
                return
            if self.view.time - start > limit:
                failure = f"did not {what} within {limit:.0f} s"
                if not in_flight:
                    raise MissionError(f"{', '.join(map(self._state, waited_for))}: {failure}")
                self._away |= set(waited_for) - {0}
                for i in waited_for:
                    self._lose(i, f"{self._state(i)} {failure}")
                return
            if command is not None and self.view.time >= due:
                for i in missing:
                    command(i)
                due = self.view.time + _REPEAT
            yield

    def _state(self, index: int) -> str:
        armed, mode = self.view.armed[index], self.view.mode[index]
        return f"{self.view.names[index]} ({'armed' if armed else 'disarmed'}, mode {mode or 'unknown'!r})"

    def _wait(self, duration: float) -> Ticks:
        end = self.view.time + duration
        while self.view.time < end:
            yield


def _silent(last: float | None, now: float, limit: float) -> bool:
    """Return whether what has been heard at time ``last`` has stopped for ``limit`` s; never for what never was."""
    return last is not None and now - last > limit


def _all_near(points: Array, others: Array) -> bool:
    """Return whether every point is at one of the others; row by row, as a large swarm's table would not fit."""
    return all(np.abs(others - point).max(axis=1).min() < _SAME_SLOT for point in points)


def _enu_to_flu(vector: Array, yaw: float) -> Array:
    """Turn a vector from ENU into the frame of a level vehicle at heading ``yaw`` (rad from east)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1], vector[2]])
