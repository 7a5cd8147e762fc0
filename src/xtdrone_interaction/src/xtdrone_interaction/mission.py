"""The formation flight as a mission: what is commanded when, by simulated time alone. No ROS here.

The mission sees the fleet through a :class:`View`, which its caller keeps up to date, and acts through a
:class:`Commands`. It is a generator that is advanced once a tick, so that it reads in the order of the flight.

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
_HOVER_TIME = 0.5  # s of set-points before OFFBOARD is asked for
_LIMITS = {"connect": 60.0, "arm": 40.0, "take-off": 40.0, "offboard": 15.0, "pattern": 10.0, "land": 90.0}  # s


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
    """

    names: Sequence[str]
    time: float = 0.0
    position: Array = field(init=False)
    connected: list[bool] = field(init=False)
    armed: list[bool] = field(init=False)
    mode: list[str] = field(init=False)
    leader_yaw: float = 0.0
    offsets: Array | None = None

    def __post_init__(self) -> None:
        """Know nothing of any vehicle yet."""
        count = len(self.names)
        self.position = np.full((count, 3), np.nan)
        self.connected = [False] * count
        self.armed = [False] * count
        self.mode = [""] * count

    def error(self) -> Array | None:
        """Return the followers' distances from their slots, shape (n - 1,), m; None before the first pattern."""
        if self.offsets is None or len(self.offsets) != len(self.names) - 1:
            return None
        return formation_error(self.position, self.offsets)


class FormationMission:
    """Take-off, the patterns in turn, landing.

    Attributes:
        phase: the phase now flown.
        step: its number, from 1.
        steps: number of phases.
        unsettled: patterns that did not settle in time.
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
        self._ground = 0.0
        self._settle_limit = settle_limit

    def fly(self) -> Ticks:
        """Fly the mission; advance once a tick.

        Raises:
            MissionError: a vehicle did not do what it was told within the limit, or left the formation's mode.
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
        """Land all vehicles where they are and wait until the last is disarmed.

        Raises:
            MissionError: a vehicle is still armed after the limit.
        """
        armed = self.view.armed
        yield from self._until(
            "land and disarm", _LIMITS["land"], lambda i: not armed[i], self._mode_command("AUTO.LAND")
        )

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
        self._begin("take-off", vehicles=list(self.view.names))
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
            "reach the take-off height",
            _LIMITS["take-off"],
            lambda i: view.mode[i] == "AUTO.LOITER" and view.position[i, 2] > self._ground + _TAKEOFF_HEIGHT,
        )

    def _arm(self, index: int) -> None:
        """Arm; a vehicle may have refused AUTO.TAKEOFF or left it in the meantime, so ask for that again."""
        if self.view.mode[index] != "AUTO.TAKEOFF":
            self.commands.vehicle(index, "AUTO.TAKEOFF")
        self.commands.vehicle(index, "ARM")

    def _offboard(self) -> Ticks:
        self._begin("offboard")
        for i in range(len(self.view.names)):
            self.commands.vehicle(i, "HOVER")  # a set-point to hold must stream before OFFBOARD is accepted
        yield from self._wait(_HOVER_TIME)
        mode = self.view.mode
        yield from self._until(
            "switch to OFFBOARD", _LIMITS["offboard"], lambda i: mode[i] == "OFFBOARD", self._mode_command("OFFBOARD")
        )

    def _form(self, pattern: str) -> Ticks:
        """Command a pattern and wait until all are in their slots."""
        self._begin(f"pattern {pattern}", pattern=pattern)
        start = due = self.view.time
        while not self._assigned(pattern):
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
            error = self.view.error()
            if error is None or error.max() > SETTLED_ERROR:
                inside = None
            elif inside is None:
                inside = self.view.time
            if inside is not None and self.view.time - inside >= SETTLED_HOLD:
                self.commands.event("settled", what=what, after=inside - start)
                return
            yield
        self.unsettled.append(what)
        error = self.view.error()
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
        for name, armed, mode in zip(self.view.names, self.view.armed, self.view.mode, strict=True):
            if not armed or mode != "OFFBOARD":
                state = "armed" if armed else "disarmed"
                raise MissionError(f"{name}: is {state} in mode {mode!r}; armed in OFFBOARD is needed")

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
    ) -> Ticks:
        """Wait until every vehicle has ``reached`` the state; command those that have not, again and again.

        Raises:
            MissionError: some have not after ``limit`` s.
        """
        start = due = self.view.time
        while missing := [i for i in range(len(self.view.names)) if not reached(i)]:
            if self.view.time - start > limit:
                states = ", ".join(
                    f"{self.view.names[i]} ({'armed' if self.view.armed[i] else 'disarmed'}, "
                    f"mode {self.view.mode[i] or 'unknown'!r})"
                    for i in missing
                )
                raise MissionError(f"{states}: did not {what} within {limit:.0f} s")
            if command is not None and self.view.time >= due:
                for i in missing:
                    command(i)
                due = self.view.time + _REPEAT
            yield

    def _wait(self, duration: float) -> Ticks:
        end = self.view.time + duration
        while self.view.time < end:
            yield


def _all_near(points: Array, others: Array) -> bool:
    """Return whether every point is at one of the others; row by row, as a large swarm's table would not fit."""
    return all(np.abs(others - point).max(axis=1).min() < _SAME_SLOT for point in points)


def _enu_to_flu(vector: Array, yaw: float) -> Array:
    """Turn a vector from ENU into the frame of a level vehicle at heading ``yaw`` (rad from east)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1], vector[2]])
