"""Script of a soak: episodes and timed events, generated from a seed; needs no ROS and no clock.

Times are simulated seconds from the beginning of the episode. The runner advances to each event and pauses the world
there, so that the same seed gives the same events at the same simulated times on any machine.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

KINDS = ("mission", "clients", "offboard", "formation_shared", "formation_merged", "formation_per_uav", "control")
"""Kinds of episodes."""
SHARES = {
    "mission": 0.54,
    "clients": 0.10,
    "offboard": 0.10,
    "formation_shared": 0.12,
    "formation_merged": 0.03,
    "formation_per_uav": 0.03,
    "control": 0.08,
}
"""Share of the simulated time by kind; kinds that are slow because of ROS nodes have a small share."""
REST = 12.0
"""s at the end of each episode: nothing flies and no node of the episode is left."""

_MEAN_LENGTH = {"mission": 390.0, "clients": 210.0, "offboard": 180.0, "control": 200.0}
_MEAN_FORMATION = 240.0
_READY = 14.0  # s after a reset until the estimators allow arming
_RADIUS = 40.0  # m from the spawn grid to the middle of a vehicle's own part of the field
_LOWEST, _HEIGHT_STEP = 6.0, 1.2  # m
_PATTERNS = ("cube", "pyramid", "triangle", "circle", "grid", "sphere", "text:XTD")
_COMMUNICATION = ("xtdrone_control", "multirotor_communication.py")
_FOLLOWER = ("xtdrone_coordination", "follower_consensus.py")
_ENDS = ("INT", "INT", "KILL", "TERM")  # signals that end listeners


@dataclass(frozen=True)
class Event:
    """A timed action.

    Attributes:
        time: s from the episode's beginning.
        action: name of a method of ``actions.Actions``.
        arguments: of the action.
    """

    time: float
    action: str
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Episode:
    """A stretch of the soak.

    Attributes:
        number: from 1.
        kind: one of KINDS.
        length: s.
        events: in order of time, all within the length.
    """

    number: int
    kind: str
    length: float
    events: tuple[Event, ...]


class _Draft:
    """An episode under construction.

    Attributes:
        rng: of the script.
        number: of the episode, part of its nodes' names.
        count: of vehicles.
        short: whether all parts have their minimum length.
        events: so far.
    """

    def __init__(self, rng: random.Random, number: int, count: int, short: bool) -> None:
        self.rng = rng
        self.number = number
        self.count = count
        self.short = short
        self.events: list[Event] = []
        self._names = 0

    def at(self, time: float, action: str, **arguments: Any) -> None:
        self.events.append(Event(round(time, 2), action, arguments))

    def name(self, what: str) -> str:
        """Return a node's name that no other has."""
        self._names += 1
        return f"soak_{self.number}_{what}_{self._names}"

    def vehicles(self, most: int) -> list[int]:
        """Return some vehicles, at least one."""
        return sorted(self.rng.sample(range(self.count), self.rng.randint(1, min(most, self.count))))

    def done(self, kind: str, end: float) -> Episode:
        """Return the episode, of which the last flight ends by ``end``."""
        self.at(end, "disarm")
        self.at(end, "end_all")
        length = end + REST
        events = sorted(self.events, key=lambda event: event.time)  # stable: events of one time keep their order
        return Episode(self.number, kind, round(length, 2), tuple(events))


def generate(seed: int, count: int, hours: float, kinds: Sequence[str] = KINDS) -> Iterator[Episode]:
    """Yield the episodes of a soak until ``hours`` of simulated time are full.

    Args:
        seed: of the script.
        count: number of vehicles, at least 2.
        hours: simulated; every kind of episode occurs at least once.
        kinds: of KINDS.
    """
    rng = random.Random(f"soak {seed} {count}")
    order = list(kinds)
    rng.shuffle(order)
    number, passed = 0, 0.0
    spent = dict.fromkeys(kinds, 0.0)
    while order or passed < hours * 3600.0:
        number += 1
        kind = order.pop() if order else _next_kind(rng, spent)
        episode = _WRITERS[kind](_Draft(rng, number, count, False))
        spent[kind] += episode.length
        passed += episode.length
        yield episode


def generate_short(seed: int, count: int) -> Iterator[Episode]:
    """Yield one brief episode of every kind, with every kind of event; see :func:`generate`."""
    rng = random.Random(f"short soak {seed} {count}")
    order = [kind for kind in KINDS if kind not in ("formation_merged", "formation_per_uav")]
    rng.shuffle(order)
    for number, kind in enumerate(order, 1):
        yield _WRITERS[kind](_Draft(rng, number, count, True))


def _next_kind(rng: random.Random, spent: Mapping[str, float]) -> str:
    """Draw the next kind according to the shares of simulated time."""
    kinds = list(spent)
    means = {kind: _MEAN_LENGTH.get(kind, _MEAN_FORMATION) for kind in kinds}
    total = sum(spent.values())
    whole = sum(SHARES[kind] for kind in kinds)
    lacking = {kind: SHARES[kind] / whole * (total + means[kind]) - spent[kind] for kind in kinds}
    weights = [max(lacking[kind], 0.02 * means[kind]) / means[kind] for kind in kinds]
    return rng.choices(kinds, weights)[0]


# ---- episodes


def _mission(draft: _Draft) -> Episode:
    rng, short = draft.rng, draft.short
    _maybe_reset(draft, 0.35)
    draft.at(1.0, "log", vehicles=draft.vehicles(max(1, draft.count // 2)))
    start = _READY
    end_of_flight = start + (35.0 if short else rng.uniform(180.0, 480.0))
    draft.at(2.0, "upload", plans=[_plan(rng, i, draft.count, short) for i in range(draft.count)])
    draft.at(start, "fly_mission")
    draft.at(start + 3.0, "fly_mission")  # for vehicles that were not ready
    draft.at(start + 10.0, "count_flying", vehicles=list(range(draft.count)))
    landing = _landing_time(draft.count)
    draft.at(end_of_flight, "land")
    if not short:
        _side_events(draft, start + 20.0, end_of_flight - 10.0, rng.randint(0, 3))
    return draft.done("mission", end_of_flight + landing)


def _clients(draft: _Draft) -> Episode:
    rng = draft.rng
    if draft.short:
        end = 34.0
        for number, what in enumerate(_SIDE_KINDS):
            _side_event(draft, what, 1.0 + 2.0 * number, 10.0, "KILL" if what in ("record", "echo") else "INT")
        _side_event(draft, "record", 2.0, 20.0, "INT")
    else:
        end = rng.uniform(100.0, 300.0)
        _side_events(draft, 1.0, end - 20.0, rng.randint(4, 8))
    return draft.done("clients", end)


def _offboard(draft: _Draft) -> Episode:
    rng, short = draft.rng, draft.short
    _maybe_reset(draft, 0.2)
    vehicle = rng.randrange(draft.count)
    draft.at(1.0, "log", vehicles=[vehicle])
    node = draft.name("communication")
    draft.at(2.0, "start", node=node, program=_COMMUNICATION, arguments=["iris", str(vehicle)])
    topic = f"/xtdrone/iris_{vehicle}"
    draft.at(_READY, "say", topic=f"{topic}/cmd", text="AUTO.TAKEOFF")
    draft.at(_READY + 0.5, "say", topic=f"{topic}/cmd", text="ARM")
    time = _READY + 10.0
    draft.at(time - 1.0, "count_flying", vehicles=[vehicle])
    draft.at(time, "say_velocity", topic=f"{topic}/cmd_vel_enu", velocity=[0.3, 0.0, 0.2])
    draft.at(time + 1.0, "say", topic=f"{topic}/cmd", text="OFFBOARD")
    end_of_flight = time + (16.0 if short else rng.uniform(60.0, 180.0))
    time += 5.0
    while time < end_of_flight - 5.0:
        velocity = [round(rng.uniform(-1.0, 1.0), 2), round(rng.uniform(-1.0, 1.0), 2), 0.0]
        draft.at(time, "say_velocity", topic=f"{topic}/cmd_vel_enu", velocity=velocity)
        time += rng.uniform(4.0, 12.0)
    if short or rng.random() < 0.5:
        _harm(draft, node, _COMMUNICATION, ["iris", str(vehicle)], end_of_flight - 4.0, "STOP" if short else "")
    draft.at(end_of_flight, "land")
    if not short:
        _side_events(draft, 5.0, end_of_flight - 10.0, rng.randint(0, 2))
    return draft.done("offboard", end_of_flight + 25.0)


def _formation_shared(draft: _Draft) -> Episode:
    count = draft.count
    nodes = [
        ("communication", _COMMUNICATION, ["iris", "all"]),
        ("follower", _FOLLOWER, ["iris", "all", str(count), "vel"]),
    ]
    return _formation(draft, "formation_shared", nodes)


def _formation_merged(draft: _Draft) -> Episode:
    count = draft.count
    nodes: list[tuple[str, tuple[str, str], list[str]]] = [("communication", _COMMUNICATION, ["iris", "0"])]
    merged = "_communication:=true"
    nodes += [("follower", _FOLLOWER, ["iris", str(i), str(count), "vel", merged]) for i in range(1, count)]
    return _formation(draft, "formation_merged", nodes)


def _formation_per_uav(draft: _Draft) -> Episode:
    count = draft.count
    nodes: list[tuple[str, tuple[str, str], list[str]]] = [
        ("communication", _COMMUNICATION, ["iris", str(i)]) for i in range(count)
    ]
    nodes += [("follower", _FOLLOWER, ["iris", str(i), str(count), "vel"]) for i in range(1, count)]
    return _formation(draft, "formation_per_uav", nodes)


def _formation(draft: _Draft, kind: str, nodes: Sequence[tuple[str, tuple[str, str], list[str]]]) -> Episode:
    rng, short = draft.rng, draft.short
    draft.at(0.0, "reset", what=rng.choice(("simulation", "world")))
    draft.at(1.0, "log", vehicles=draft.vehicles(max(1, draft.count // 3)))
    leader = ("leader", ("xtdrone_coordination", "leader.py"), ["iris", str(draft.count)])
    started = [(draft.name(what), program, arguments) for what, program, arguments in (*nodes, leader)]
    for name, program, arguments in started:
        draft.at(2.0, "start", node=name, program=program, arguments=arguments)
    topics = [f"/xtdrone/iris_{i}/cmd" for i in range(draft.count)]
    flight = _READY
    for after, word in ((0.0, "AUTO.TAKEOFF"), (0.5, "ARM"), (3.0, "ARM"), (10.0, "HOVER"), (11.0, "OFFBOARD")):
        for topic in topics:
            draft.at(flight + after, "say", topic=topic, text=word)
    draft.at(flight + 9.0, "count_flying", vehicles=list(range(draft.count)))
    time = flight + 13.0
    first = time
    for pattern in ["origin", *rng.sample(_PATTERNS, 1 if short else rng.randint(2, 4)), "origin"]:
        draft.at(time, "say", topic="/xtdrone/leader/cmd", text=pattern)
        time += 6.0 if short else rng.uniform(20.0, 40.0)
        velocity = [round(rng.uniform(0.0, 0.5), 2), 0.0, 0.0]
        draft.at(time - 4.0, "say_velocity", topic="/xtdrone/leader/cmd_vel_flu", velocity=velocity)
        draft.at(time - 1.0, "say_velocity", topic="/xtdrone/leader/cmd_vel_flu", velocity=[0.0, 0.0, 0.0])
    harms = ("STOP", "TERM", "KILL") if short else rng.sample(("STOP", "TERM", "KILL", "", ""), rng.randint(0, 2))
    moments = sorted(rng.uniform(first + 4.0, time - 5.0) for _ in harms)
    for how, moment in zip(harms, moments, strict=True):
        victim = rng.choice(started)
        _harm(draft, *victim, moment, how)
        if how != "STOP":
            started.remove(victim)  # no second kill of the same node
    draft.at(time, "land")
    if not short:
        _side_events(draft, 5.0, time - 10.0, rng.randint(0, 2))
        if rng.random() < 0.15:
            draft.at(rng.uniform(first, time), "reset", what=rng.choice(("simulation", "world")))
    return draft.done(kind, time + 30.0)


def _control(draft: _Draft) -> Episode:
    rng, short = draft.rng, draft.short
    draft.at(0.0, "reset", what="simulation")
    draft.at(1.0, "log", vehicles=draft.vehicles(2))
    draft.at(_READY, "take_off", height=5.0)
    time = _READY + 8.0
    draft.at(time - 1.0, "count_flying", vehicles=list(range(draft.count)))
    tricks = ["pause", "ticks", "speed", "free", "pause_in_step"]
    for _ in range(1 if short else 3):
        rng.shuffle(tricks)
        for trick in tricks:
            draft.at(time, trick, **_trick(rng, trick, short))
            time += 3.0 if short else rng.uniform(6.0, 12.0)
    draft.at(time, "speed", factor=0.0)
    time += 2.0
    what = rng.choice(("simulation", "world"))
    draft.at(time, "reset", what=what)  # in the air
    draft.at(time + _READY, "take_off", height=4.0)
    time += _READY + 10.0
    draft.at(time - 1.0, "count_flying", vehicles=list(range(draft.count)))
    draft.at(time, "reset", what="simulation" if what == "world" else "world")
    draft.at(time + 2.0, "land")
    return draft.done("control", time + 6.0)


def _trick(rng: random.Random, trick: str, short: bool) -> dict[str, Any]:
    if trick in ("pause", "pause_in_step"):
        return {"wall": 0.2 if short else round(rng.uniform(0.2, 2.0), 2)}
    if trick == "ticks":
        return {"count": rng.randint(1, 8)}
    if trick == "speed":
        return {"factor": float(rng.choice((0.0, 5.0, 10.0, 20.0)))}
    return {"seconds": 1.0 if short else round(rng.uniform(2.0, 5.0), 2), "factor": 4.0}


_WRITERS: dict[str, Callable[[_Draft], Episode]] = {
    "mission": _mission,
    "clients": _clients,
    "offboard": _offboard,
    "formation_shared": _formation_shared,
    "formation_merged": _formation_merged,
    "formation_per_uav": _formation_per_uav,
    "control": _control,
}


# ---- parts of episodes


def _maybe_reset(draft: _Draft, chance: float) -> None:
    if draft.rng.random() < chance:
        draft.at(0.0, "reset", what=draft.rng.choice(("simulation", "world")))


def height_of(vehicle: int) -> float:
    """Return the height above home at which a vehicle flies its missions, m."""
    return _LOWEST + _HEIGHT_STEP * vehicle


def _landing_time(count: int) -> float:
    """Return a generous time for the highest vehicle to land and disarm, s."""
    return 25.0 + height_of(count - 1) / 1.0


def _plan(rng: random.Random, vehicle: int, count: int, short: bool) -> dict[str, Any]:
    """Return a mission in the vehicle's own part of the field: waypoints (east, north, m) and number of rounds."""
    angle = 2.0 * math.pi * vehicle / count
    middle = (_RADIUS * math.cos(angle), _RADIUS * math.sin(angle))
    width = min(10.0, 0.35 * 2.0 * math.pi * _RADIUS / count)
    places = [
        [round(middle[0] + rng.uniform(-width, width), 2), round(middle[1] + rng.uniform(-width, width), 2)]
        for _ in range(2 if short else rng.randint(3, 7))
    ]
    return {"places": places, "height": height_of(vehicle), "rounds": 0 if short else rng.randint(1, 12)}


def _harm(draft: _Draft, node: str, program: tuple[str, str], arguments: Sequence[str], time: float, how: str) -> None:
    """End or suspend a node in flight; ``how``: STOP, TERM, KILL, or empty for any; an ended one may be restarted."""
    how = how or draft.rng.choice(("STOP", "TERM", "KILL"))
    if how == "STOP":
        draft.at(time, "halt", node=node, wall=0.5 if draft.short else round(draft.rng.uniform(0.5, 3.0), 2))
        return
    draft.at(time, "end", node=node, signal=how)
    if draft.rng.random() < 0.6:
        again = draft.name("again")
        draft.at(time + 1.0, "start", node=again, program=program, arguments=list(arguments))


_SIDE_KINDS = ("record", "echo", "params", "logs", "status", "burst")


def _side_events(draft: _Draft, first: float, last: float, count: int) -> None:
    """Start and end listeners and ground stations within a span."""
    for _ in range(count):
        begin = draft.rng.uniform(first, max(first, last - 20.0))
        length = draft.rng.uniform(10.0, max(10.0, min(90.0, last - begin)))
        _side_event(draft, draft.rng.choice(_SIDE_KINDS), begin, length, draft.rng.choice(_ENDS))


def _side_event(draft: _Draft, what: str, time: float, length: float, how: str) -> None:
    rng = draft.rng
    vehicle = rng.randrange(draft.count)
    if what == "burst":
        draft.at(time, "burst", sockets=5 if draft.short else rng.randint(5, 40))
        return
    name = draft.name(what)
    if what == "record":
        topics = ["/gazebo/model_states", "/rosout"] if rng.random() < 0.5 else ["/rosout"]
        for i in draft.vehicles(3):
            topics += [f"/iris_{i}/mavros/local_position/pose", f"/iris_{i}/mavros/state", f"/iris_{i}/mavros/imu/data"]
        draft.at(time, "record", node=name, topics=topics)
    elif what == "echo":
        leaf = rng.choice(("imu/data", "local_position/odom", "state", "global_position/global"))
        draft.at(time, "echo", node=name, topic=f"/iris_{vehicle}/mavros/{leaf}")
    else:
        draft.at(time, "client", node=name, what=what, vehicle=vehicle)
    draft.at(time + length, "end", node=name, signal=how)
