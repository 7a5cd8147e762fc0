"""Script of a soak: episodes of random actions from a seed; needs no ROS and no clock.

Times are simulated seconds from the beginning of the episode. The runner advances to each event and pauses the world
there, so that the same seed gives the same events at the same simulated times on any machine.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

SHARES = {
    "mission": 0.54,
    "clients": 0.10,
    "offboard": 0.10,
    "formation_shared": 0.12,
    "formation_merged": 0.03,
    "formation_per_uav": 0.03,
    "control": 0.08,
}
"""Shares of the simulated time by kind of episode; kinds that are slow because of ROS nodes have a small one."""
KINDS = tuple(SHARES)
REST = 12.0
"""s at the end of each episode: nothing flies and no node of the episode is left."""
_READY = 14.0  # s after a reset until the estimators allow arming
_RADIUS = 40.0  # m from the spawn grid to the middle of a vehicle's own part of the field
_PATTERNS = ("cube", "pyramid", "triangle", "circle", "grid", "sphere", "text:XTD")
_COMMUNICATION = ("xtdrone_control", "multirotor_communication.py")
_FOLLOWER = ("xtdrone_coordination", "follower_consensus.py")
_CLIENTS = ("record", "params", "logs", "status", "burst")
_Program = tuple[tuple[str, str], list[str]]


@dataclass(frozen=True)
class Event:
    """Timed action.

    Attributes:
        time: Time from the episode's beginning, s.
        action: Name of a method of ``actions.Actions``.
        arguments: Arguments of the action.
    """

    time: float
    action: str
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Episode:
    """Stretch of the soak.

    Attributes:
        number: Number from 1.
        kind: One of KINDS.
        length: Length, s.
        events: Events in order of time, all within the length.
    """

    number: int
    kind: str
    length: float
    events: tuple[Event, ...]


class _Draft:
    """Episode under construction; in a short soak all its parts have their minimum length."""

    def __init__(self, rng: random.Random, number: int, count: int, short: bool) -> None:
        self.rng, self.number, self.count, self.short = rng, number, count, short
        self.events: list[Event] = []

    def at(self, time: float, action: str, **arguments: Any) -> None:
        self.events.append(Event(round(time, 2), action, arguments))

    def start(self, time: float, program: tuple[str, str], arguments: list[str]) -> str:
        """Start a node under a name that no other has; return the name."""
        name = f"soak_{self.number}_{program[1].split('.')[0].replace('_', '')}_{len(self.events)}"
        self.at(time, "start", node=name, program=program, arguments=arguments)
        return name

    def lasts(self, least: float, low: float, high: float) -> float:
        """Return a length, s: the least in a short soak."""
        return least if self.short else self.rng.uniform(low, high)

    def harm(self, time: float, node: str, program: _Program, how: str) -> None:
        """Suspend a node in flight, or end it by a signal and restart it in three cases of five."""
        if how == "STOP":
            self.at(time, "halt", node=node, wall=round(self.lasts(0.5, 0.5, 3.0), 2))
        else:
            self.at(time, "end", node=node, signal=how)
            if self.rng.random() < 0.6:
                self.start(time + 1.0, *program)

    def clients(self, first: float, last: float, kinds: Sequence[str]) -> None:
        """Start and end recorders and ground stations within a span."""
        for number, what in enumerate(kinds):
            begin = first + 2.0 * number if self.short else self.rng.uniform(first, max(first, last - 20.0))
            vehicle = self.rng.randrange(self.count)
            if what == "burst":
                self.at(begin, "burst", sockets=5 if self.short else self.rng.randint(5, 40))
                continue
            name = f"soak_{self.number}_{what}_{len(self.events)}"
            if what == "record":
                topics = [f"/iris_{vehicle}/mavros/{leaf}" for leaf in ("local_position/pose", "state", "imu/data")]
                self.at(begin, "record", node=name, topics=["/gazebo/model_states", "/rosout", *topics])
            else:
                self.at(begin, "client", node=name, what=what, vehicle=vehicle)
            end = begin + self.lasts(10.0, 10.0, max(10.0, min(90.0, last - begin)))
            self.at(end, "end", node=name, signal=self.rng.choice(("INT", "INT", "KILL", "TERM")))

    def more_clients(self, first: float, last: float, most: int) -> None:
        """Let some clients come and go beside a flight, none in a short soak."""
        if not self.short:
            self.clients(first, last, self.rng.choices(_CLIENTS, k=self.rng.randint(0, most)))

    def episode(self, kind: str, end: float) -> Episode:
        """Return the episode, whose last flight ends by ``end``."""
        self.at(end, "disarm")
        self.at(end, "end_all")
        events = sorted(self.events, key=lambda event: event.time)  # stable: events of one time keep their order
        return Episode(self.number, kind, round(end + REST, 2), tuple(events))


def generate(seed: int, count: int, hours: float, kinds: Sequence[str] = KINDS) -> Iterator[Episode]:
    """Yield the episodes of a soak until ``hours`` of simulated time are full.

    Args:
        seed: Seed of the script.
        count: Number of vehicles, at least 2.
        hours: Simulated length, h; every kind of episode occurs at least once.
        kinds: Kinds of episodes, of KINDS.
    """
    rng = random.Random(f"soak {seed} {count}")
    spent = dict.fromkeys(kinds, 0.0)
    number = 0
    while sum(spent.values()) < hours * 3600.0 or not all(spent.values()):
        number += 1
        waiting = [kind for kind in kinds if not spent[kind]]
        # The kind that lacks most of its share comes next.
        kind = rng.choice(waiting) if waiting else min(kinds, key=lambda kind: spent[kind] / SHARES[kind])
        episode = _WRITERS[kind](_Draft(rng, number, count, False), kind)
        spent[kind] += episode.length
        yield episode


def generate_short(seed: int, count: int) -> Iterator[Episode]:
    """Yield one brief episode of every kind but two forms of the formation; see :func:`generate`."""
    rng = random.Random(f"short soak {seed} {count}")
    for number, kind in enumerate(("mission", "clients", "offboard", "formation_shared", "control"), 1):
        yield _WRITERS[kind](_Draft(rng, number, count, True), kind)


def height_of(vehicle: int) -> float:
    """Return the height above home at which a vehicle flies its missions, m."""
    return 6.0 + 1.2 * vehicle


def _mission(draft: _Draft, kind: str) -> Episode:
    rng = draft.rng
    if rng.random() < 0.35:
        draft.at(0.0, "reset", what=rng.choice(("simulation", "world")))
    draft.at(1.0, "log", vehicles=list(range(0, draft.count, 2)))
    end = _READY + draft.lasts(35.0, 180.0, 480.0)
    draft.at(2.0, "upload", plans=[_plan(draft, i) for i in range(draft.count)])
    draft.at(_READY, "fly_mission")
    draft.at(_READY + 3.0, "fly_mission")  # for vehicles that were not ready
    draft.at(_READY + 10.0, "count_flying", vehicles=list(range(draft.count)))
    draft.at(end, "land")
    draft.more_clients(_READY + 20.0, end - 10.0, 3)
    return draft.episode(kind, end + 25.0 + height_of(draft.count - 1))


def _plan(draft: _Draft, vehicle: int) -> dict[str, Any]:
    """Return a mission in the vehicle's own part of the field: waypoints (east, north, m) and number of rounds."""
    rng, angle = draft.rng, 2.0 * math.pi * vehicle / draft.count
    middle = (_RADIUS * math.cos(angle), _RADIUS * math.sin(angle))
    width = min(10.0, 0.7 * math.pi * _RADIUS / draft.count)
    number = 2 if draft.short else rng.randint(3, 7)
    places = [[round(at + rng.uniform(-width, width), 2) for at in middle] for _ in range(number)]
    return {"places": places, "height": height_of(vehicle), "rounds": 0 if draft.short else rng.randint(1, 12)}


def _clients(draft: _Draft, kind: str) -> Episode:
    end = draft.lasts(34.0, 100.0, 300.0)
    kinds = (*_CLIENTS, "record") if draft.short else draft.rng.choices(_CLIENTS, k=draft.rng.randint(4, 8))
    draft.clients(1.0, end - 20.0, kinds)
    return draft.episode(kind, end)


def _offboard(draft: _Draft, kind: str) -> Episode:
    rng, vehicle = draft.rng, draft.rng.randrange(draft.count)
    draft.at(1.0, "log", vehicles=[vehicle])
    program: _Program = (_COMMUNICATION, ["iris", str(vehicle)])
    node = draft.start(2.0, *program)
    topic = f"/xtdrone/iris_{vehicle}"
    draft.at(_READY, "say", topic=f"{topic}/cmd", text="AUTO.TAKEOFF")
    draft.at(_READY + 0.5, "say", topic=f"{topic}/cmd", text="ARM")
    draft.at(_READY + 9.0, "count_flying", vehicles=[vehicle])
    time = _READY + 10.0
    draft.at(time, "say_velocity", topic=f"{topic}/cmd_vel_enu", velocity=[0.3, 0.0, 0.2])
    draft.at(time + 1.0, "say", topic=f"{topic}/cmd", text="OFFBOARD")
    end = time + draft.lasts(16.0, 60.0, 180.0)
    while (time := time + rng.uniform(4.0, 12.0)) < end - 5.0:
        velocity = [round(rng.uniform(-1.0, 1.0), 2), round(rng.uniform(-1.0, 1.0), 2), 0.0]
        draft.at(time, "say_velocity", topic=f"{topic}/cmd_vel_enu", velocity=velocity)
    draft.harm(end - 4.0, node, program, "STOP" if draft.short else rng.choice(("STOP", "TERM", "KILL")))
    draft.at(end, "land")
    draft.more_clients(5.0, end - 10.0, 2)
    return draft.episode(kind, end + 25.0)


def _formation(draft: _Draft, kind: str) -> Episode:
    rng, count = draft.rng, draft.count
    followers = [str(i) for i in range(1, count)] if kind != "formation_shared" else ["all"]
    speakers = {"formation_shared": ["all"], "formation_merged": ["0"]}.get(kind, ["0", *followers])
    merged = ["_communication:=true"] if kind == "formation_merged" else []
    programs: list[_Program] = [(_COMMUNICATION, ["iris", who]) for who in speakers]
    programs += [(_FOLLOWER, ["iris", who, str(count), "vel", *merged]) for who in followers]
    programs.append((("xtdrone_coordination", "leader.py"), ["iris", str(count)]))
    draft.at(0.0, "reset", what=rng.choice(("simulation", "world")))
    draft.at(1.0, "log", vehicles=[0])
    started = [(draft.start(2.0, *program), program) for program in programs]
    for after, word in ((0.0, "AUTO.TAKEOFF"), (0.5, "ARM"), (3.0, "ARM"), (10.0, "HOVER"), (11.0, "OFFBOARD")):
        for i in range(count):
            draft.at(_READY + after, "say", topic=f"/xtdrone/iris_{i}/cmd", text=word)
    draft.at(_READY + 9.0, "count_flying", vehicles=list(range(count)))
    first = time = _READY + 13.0
    for pattern in ["origin", *rng.sample(_PATTERNS, 1 if draft.short else rng.randint(2, 4)), "origin"]:
        draft.at(time, "say", topic="/xtdrone/leader/cmd", text=pattern)
        time += draft.lasts(6.0, 20.0, 40.0)
        for before, speed in ((4.0, round(rng.uniform(0.0, 0.5), 2)), (1.0, 0.0)):
            topic = "/xtdrone/leader/cmd_vel_flu"
            draft.at(time - before, "say_velocity", topic=topic, velocity=[speed, 0.0, 0.0])
    if draft.short:
        started.pop()  # the leader: the script's words to it are to be heard
    for how in ("STOP", "TERM", "KILL") if draft.short else rng.sample(("STOP", "TERM", "KILL"), rng.randint(0, 2)):
        victim = rng.choice(started)
        draft.harm(rng.uniform(first + 4.0, time - 5.0), *victim, how)
        if how != "STOP":
            started.remove(victim)  # an ended node is not ended again
    draft.at(time, "land")
    draft.more_clients(5.0, time - 10.0, 2)
    return draft.episode(kind, time + 30.0)


def _control(draft: _Draft, kind: str) -> Episode:
    rng = draft.rng
    tricks: dict[str, Callable[[], dict[str, Any]]] = {
        "pause": lambda: {"wall": round(draft.lasts(0.2, 0.2, 2.0), 2)},
        "pause_in_step": lambda: {"wall": round(draft.lasts(0.2, 0.2, 2.0), 2)},
        "ticks": lambda: {"count": rng.randint(1, 8)},
        "speed": lambda: {"factor": rng.choice((0.0, 5.0, 10.0, 20.0))},
    }
    everyone = list(range(draft.count))
    draft.at(0.0, "reset", what="simulation")
    draft.at(1.0, "log", vehicles=[0, 1])
    draft.at(_READY, "take_off", height=5.0)
    time = _READY + 8.0
    draft.at(time - 1.0, "count_flying", vehicles=everyone)
    for trick in rng.sample(list(tricks), 4) if draft.short else rng.choices(list(tricks), k=12):
        draft.at(time, trick, **tricks[trick]())
        time += draft.lasts(3.0, 6.0, 12.0)
    draft.at(time, "speed", factor=0.0)
    draft.at(time + 2.0, "reset", what="world")  # in the air
    draft.at(time + 2.0 + _READY, "take_off", height=4.0)
    time += _READY + 12.0
    draft.at(time - 1.0, "count_flying", vehicles=everyone)
    draft.at(time, "reset", what="simulation")
    return draft.episode(kind, time + 8.0)


_WRITERS: dict[str, Callable[[_Draft, str], Episode]] = {
    "mission": _mission,
    "clients": _clients,
    "offboard": _offboard,
    "control": _control,
    **dict.fromkeys((kind for kind in KINDS if kind.startswith("formation")), _formation),
}
