"""Keyboard and gamepad of pages, on the topics of multirotor_keyboard_control."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any

import rospy
from geometry_msgs.msg import Twist, Vector3
from std_msgs.msg import String

from xtdrone_common.fleet import FleetError, parse_fleet
from xtdrone_coordination.patterns import Patterns
from xtdrone_interaction.keyboard.command_topics import PERIOD
from xtdrone_interaction.keyboard.key_bindings import MAX_SPEED, MAX_TURN, Command, Message, digits
from xtdrone_interaction.topics.connected_publishers import ConnectedPublishers
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session
from xtdrone_interaction.web.steering.page_pilot import PagePilot

MODES = ("vel", "accel")
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_TEXT = re.compile(r"^[ -~]{1,200}$", re.ASCII)
_LIMITS = (MAX_SPEED, MAX_SPEED, MAX_SPEED, MAX_TURN)
_MOST_VEHICLES = 250
_CONNECT_LIMITS = 2.0, 30.0  # s of wall time in which a new station connects to most vehicles' nodes, and to the rest
_MOST_TOPICS = (1 + len(MODES)) * (1 + _MOST_VEHICLES)  # commands and setpoints of the leader and the vehicles


class SteeringRoom:
    """Flies vehicles or the leader for pages, one pilot for each page."""

    def __init__(self, context: StationContext) -> None:
        """Begin the cycle of the setpoints."""
        self._context = context
        self._pilots: dict[Session, PagePilot] = {}
        self._topics = ConnectedPublishers(context.master, _MOST_TOPICS)
        self._waiting: dict[Session, list[dict[str, Any]]] = {}
        self._send_method = Method("steering.send", self._send, "operate")
        self._sending: asyncio.Task[None] | None = None
        context.every(PERIOD, self._cycle)

    def methods(self) -> list[Method]:
        """Return the methods of a page; ``alive`` has no effect for a page that flies nothing."""
        return [
            Method("steering.open", self._open, "operate", "nothing"),
            Method("steering.key", self._key, "operate", "nothing"),
            Method("steering.sticks", self._sticks, "operate", "nothing"),
            Method("steering.close", self._close, "operate", "nothing"),
            Method("steering.stop", self._stop, "operate", "nothing"),
            self._send_method,
            Method("steering.alive", self._alive),
        ]

    async def _open(self, session: Session, params: Params) -> dict[str, Any]:
        known = await self._context.blocking(_fleet)
        vehicles, mode = _steered(params, known)
        deaf = await self._context.blocking(self._unconnected, vehicles, mode)
        self._end(session)

        def send(name: str, message: Message) -> None:
            self._waiting.setdefault(session, []).append({"to": name, "mode": mode, **_as_json(message)})

        self._pilots[session] = PagePilot(vehicles, params.get("leader") is True, _patterns(known), send)
        self._end_others(session)
        session.on_close(lambda: self._end(session))
        note = f"no node receives commands for {', '.join(deaf)}; start multirotor_communication.py" if deaf else ""
        return {**self._pilots[session].state, "note": note}

    def _unconnected(self, vehicles: Sequence[str], mode: str) -> list[str]:
        """Connect to the subscribers, so that the first key reaches them; return the vehicles without one."""
        names = ("leader", *vehicles)
        commands = {_command_topic(name): String for name in names}
        found = self._topics.connect({**commands, **{_setpoint_topic(name, mode): Twist for name in names}})
        return [name for name in vehicles if not found[_command_topic(name)]]

    def _key(self, session: Session, params: Params) -> dict[str, Any]:
        pilot = self._pilot(session)
        pilot.press(needed(params, "key", str, "a key"), time.monotonic())
        self._end_others(session)
        self._send_waiting()
        return pilot.state

    def _sticks(self, session: Session, params: Params) -> dict[str, Any]:
        pilot = self._pilot(session)
        pilot.steer(params.get("speeds"), time.monotonic())
        return pilot.state

    def _alive(self, session: Session, _params: Params) -> dict[str, Any]:
        pilot = self._pilot(session)
        pilot.alive(time.monotonic())
        return pilot.state

    def _close(self, session: Session, _params: Params) -> None:
        self._end(session)

    async def _stop(self, session: Session, params: Params) -> dict[str, Any]:
        """Stop what a page flew by a station that was killed, except what other pages fly by now.

        Returns:
            Names of those whose node receives it, vehicles or the leader.
        """
        vehicles, mode = _steered(params, await self._context.blocking(_fleet))
        flown = frozenset[str]().union(*(pilot.targets for pilot in self._pilots.values()))
        waiting = [name for name in (("leader",) if params.get("leader") is True else vehicles) if name not in flown]
        still = {"mode": mode, "speeds": [0.0] * len(_LIMITS)}
        stopped: list[str] = []
        for limit in _CONNECT_LIMITS:
            topics = {_setpoint_topic(name, mode): Twist for name in waiting}
            found = await self._context.blocking(self._topics.connect, topics, limit)
            connected = [name for name in waiting if found[_setpoint_topic(name, mode)]]
            waiting = [name for name in waiting if name not in connected]
            if connected:
                self._waiting.setdefault(session, []).extend({"to": name, **still} for name in connected)
                self._send_waiting()
                stopped += connected
            if not waiting:
                break
        return {"stopped": stopped}

    def _pilot(self, session: Session) -> PagePilot:
        pilot = self._pilots.get(session)
        if pilot is None:
            raise CallError("steering: this page flies nothing; steering.open comes first")
        return pilot

    def _end_others(self, session: Session) -> None:
        """End the pilots of other pages with the same targets: the last page to steer has control."""
        mine = self._pilots[session].targets
        for other in [page for page, pilot in self._pilots.items() if page is not session and pilot.targets & mine]:
            both = ", ".join(sorted(self._pilots[other].targets & mine))
            self._end(other)
            other.push("steering.ended", {"text": f"another page steers {both} now; this page no longer does"})

    def _end(self, session: Session) -> None:
        pilot = self._pilots.pop(session, None)
        if pilot is not None:
            pilot.end()
            self._send_waiting()

    def _cycle(self) -> None:
        now = time.monotonic()
        for pilot in list(self._pilots.values()):
            pilot.cycle(now)
        self._send_waiting()

    def _send_waiting(self) -> None:
        """Publish the pilots' messages as actions of their pages, or directly while the station ends."""
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            for messages in self._waiting.values():
                self._publish(messages)
            self._waiting.clear()
            return
        if self._waiting and (self._sending is None or self._sending.done()):
            self._sending = asyncio.ensure_future(self._send_in_order())

    async def _send_in_order(self) -> None:
        while self._waiting:
            session = next(iter(self._waiting))
            await self._context.act(self._send_method, session, {"messages": self._waiting.pop(session)})

    async def _send(self, _session: Session, params: Params) -> None:
        """Publish messages of a page's pilot; also of a recorded one."""
        messages = checked_messages(params.get("messages"))
        known = await self._context.blocking(_fleet)
        for message in messages:
            if known and message["to"] not in ("leader", *known):
                raise CallError(f"to: {message['to'][:60]!r} is not allowed, leader or one of {', '.join(known)}")
        await self._context.blocking(self._publish, messages)

    def _publish(self, messages: Sequence[Mapping[str, Any]]) -> None:
        for message in messages:
            if "text" in message:
                self._topics.publish(_command_topic(message["to"]), String(message["text"]))
            else:
                forward, left, up, turn = message["speeds"]
                twist = Twist(Vector3(forward, left, up), Vector3(0.0, 0.0, turn))
                self._topics.publish(_setpoint_topic(message["to"], message["mode"]), twist)


def _steered(params: Params, known: Sequence[str]) -> tuple[list[str], str]:
    """Return the vehicles that a page flies, and the quantity that its keys set, one of ``MODES``.

    Args:
        params: of the call.
        known: vehicles of the fleet; empty if it is not known.

    Raises:
        CallError: one is not allowed.
    """
    vehicles = needed(params, "vehicles", list, "a list of vehicles")
    for name in vehicles:
        if not isinstance(name, str) or not _NAME.fullmatch(name) or (known and name not in known):
            raise CallError(f"vehicles: {str(name)[:60]!r} is not allowed, one of {', '.join(known) or 'the fleet'}")
    if len(vehicles) > _MOST_VEHICLES:
        raise CallError(f"vehicles: {len(vehicles)} are not allowed, at most {_MOST_VEHICLES}")
    mode = params.get("mode", "vel")
    if mode not in MODES:
        raise CallError(f"mode: {str(mode)[:20]!r} is not allowed, vel or accel")
    return vehicles, mode


def _command_topic(name: str) -> str:
    return f"/xtdrone/{name}/cmd"


def _setpoint_topic(name: str, mode: str) -> str:
    return f"/xtdrone/{name}/cmd_{mode}_flu"


def _as_json(message: Message) -> dict[str, Any]:
    if isinstance(message, Command):
        return {"text": message.text}
    return {"speeds": [message.forward, message.left, message.up, message.turn]}


def checked_messages(messages: object) -> list[dict[str, Any]]:
    """Return a pilot's messages.

    Raises:
        CallError: one is neither a text nor four speeds within the limits, to a vehicle or the leader.
    """
    if not isinstance(messages, list) or not all(map(_is_message, messages)):
        allowed = "a list of {to, mode, text} or {to, mode, speeds}"
        raise CallError(f"messages: {str(messages)[:80]} is not allowed, {allowed}")
    return messages


def _is_message(message: object) -> bool:
    if not isinstance(message, dict) or message.get("mode") not in MODES:
        return False
    if not isinstance(message.get("to"), str) or not _NAME.match(message["to"]):
        return False
    if "text" in message:
        return isinstance(message["text"], str) and bool(_TEXT.match(message["text"]))
    speeds = message.get("speeds")
    return (
        isinstance(speeds, list)
        and len(speeds) == len(_LIMITS)
        and all(type(v) in (int, float) and abs(v) <= most for v, most in zip(speeds, _LIMITS, strict=True))
    )


def _patterns(known: list[str]) -> dict[str, str]:
    """Return the patterns of the leader by digit, those of XTDrone for a fleet of this size."""
    return digits(Patterns(len(known)).names) if len(known) > 1 else {}


def _fleet() -> list[str]:
    """Return the vehicles of the fleet's parameter, none if it is not set."""
    try:
        return [vehicle.name for vehicle in parse_fleet(str(rospy.get_param("/xtdrone/fleet")))]
    except (KeyError, FleetError):
        return []
