"""Keyboard and gamepad of pages, on the topics of multirotor_keyboard_control."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Any

import rospy

from xtdrone_control.fleet import FleetError, parse_fleet
from xtdrone_coordination.patterns import Patterns
from xtdrone_interaction.keyboard.command_topics import PERIOD, CommandTopics
from xtdrone_interaction.keyboard.key_bindings import Command, Message, digits
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session
from xtdrone_interaction.web.steering.page_pilot import PagePilot

MODES = ("vel", "accel")
_NAME = re.compile(r"^[A-Za-z]\w*$", re.ASCII)
_MOST_VEHICLES = 250
_CONNECTING = 2.0  # s of wall time until subscribers have connected


class SteeringRoom:
    """Flies vehicles or the leader for pages, one pilot for each page."""

    def __init__(self, context: StationContext) -> None:
        """Begin the cycle of the setpoints."""
        self._context = context
        self._pilots: dict[Session, PagePilot] = {}
        self._topics: dict[tuple[str, str], CommandTopics] = {}
        context.every(PERIOD, self._cycle)

    def methods(self) -> list[Method]:
        """Return the methods of a page; a page that flies nothing cannot call ``alive`` with effect."""
        return [
            Method("steering.open", self._open, "operate"),
            Method("steering.key", self._key, "operate"),
            Method("steering.sticks", self._sticks, "operate"),
            Method("steering.close", self._close, "operate"),
            Method("steering.alive", self._alive),
        ]

    async def _open(self, session: Session, params: Params) -> dict[str, Any]:
        vehicles = needed(params, "vehicles", list, "a list of vehicles")
        known = await self._context.blocking(_fleet)
        for name in vehicles:
            if not isinstance(name, str) or not _NAME.match(name) or (known and name not in known):
                raise CallError(
                    f"vehicles: {str(name)[:60]!r} is not allowed, one of {', '.join(known) or 'the fleet'}"
                )
        if len(vehicles) > _MOST_VEHICLES:
            raise CallError(f"vehicles: {len(vehicles)} are not allowed, at most {_MOST_VEHICLES}")
        mode = params.get("mode", "vel")
        if mode not in MODES:
            raise CallError(f"mode: {str(mode)[:20]!r} is not allowed, vel or accel")
        for name in ("leader", *vehicles):
            if (name, mode) not in self._topics:
                self._topics[name, mode] = await self._context.blocking(CommandTopics, name, mode)
        deaf = await self._context.blocking(self._unconnected, vehicles, mode)
        self._end(session)

        def send(name: str, message: Message) -> None:
            topics = self._topics[name, mode]
            if isinstance(message, Command):
                topics.send_command(message.text)
            else:
                topics.send_setpoint(message)

        self._pilots[session] = PagePilot(vehicles, params.get("leader") is True, _patterns(known), send)
        session.on_close(lambda: self._end(session))
        note = f"no node receives commands for {', '.join(deaf)}; start multirotor_communication.py" if deaf else ""
        return {**self._pilots[session].state, "note": note}

    def _unconnected(self, vehicles: Sequence[str], mode: str) -> list[str]:
        """Wait for subscribers, so that the first key reaches them; return the vehicles without one."""
        end = time.monotonic() + _CONNECTING
        return [name for name in vehicles if not self._topics[name, mode].wait_for_subscriber(end - time.monotonic())]

    def _key(self, session: Session, params: Params) -> dict[str, Any]:
        pilot = self._pilot(session)
        pilot.press(needed(params, "key", str, "a key"), time.monotonic())
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

    def _pilot(self, session: Session) -> PagePilot:
        pilot = self._pilots.get(session)
        if pilot is None:
            raise CallError("steering: this page flies nothing; steering.open comes first")
        return pilot

    def _end(self, session: Session) -> None:
        pilot = self._pilots.pop(session, None)
        if pilot is not None:
            pilot.end()

    def _cycle(self) -> None:
        now = time.monotonic()
        for pilot in list(self._pilots.values()):
            pilot.cycle(now)


def _patterns(known: list[str]) -> dict[str, str]:
    """Return the patterns of the leader by digit, those of XTDrone for a fleet of this size."""
    return digits(Patterns(len(known)).names) if len(known) > 1 else {}


def _fleet() -> list[str]:
    """Return the vehicles of the parameter of the fleet, none without it."""
    try:
        return [vehicle.name for vehicle in parse_fleet(str(rospy.get_param("/xtdrone/fleet")))]
    except (KeyError, FleetError):
        return []
