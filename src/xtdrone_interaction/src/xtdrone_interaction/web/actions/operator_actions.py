"""Carry out operators' actions: published, one after the other, those on the flight between two ticks.

A subscriber of the topic first receives all actions on the flight so far: the bag of a recorder started late has
everything that a replay needs.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from typing import Any

import rospy
from std_msgs.msg import String

import xtdrone_lockstep as lockstep
from xtdrone_interaction.web.actions.held_time import Instant, hold, let_go
from xtdrone_interaction.web.actions.recorded_actions import LET_GO, REFUSED, TOPIC
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.server.methods import Method, Params, invoke
from xtdrone_interaction.web.server.session import Session

_KEPT = 10_000  # actions
_KEPT_TEXT = 64 << 20  # characters of all of them
_LONGEST_ACTION = (
    3.0  # s of wall time that an action may let simulated time stand still; the simulator ends a hold after 5 s
)
_SILENT = frozenset({"steering.send"})  # ten a second; pages that steer the same vehicle are told by their own event
_MOST_NAMES = 4
_LONGEST_NOTICE = 120  # characters
_SHORT_STEP = 0.2  # s of wall time that an action waits for the end of a step, to take effect after it


class OperatorActions:
    """Publishes and carries out the calls of role ``operate``; used in the event loop.

    Attributes:
        station: number of this start of the station, which no other start has.
    """

    def __init__(self, context: StationContext) -> None:
        """Advertise the topic."""
        self._context = context
        self._so_far: list[String] = []
        self._so_far_text = 0  # characters
        self.station = time.time_ns()
        self._number = 0
        self._publisher = lockstep.UncountedPublisher(TOPIC, String, queue_size=_KEPT)
        listener = rospy.SubscribeListener()
        listener.peer_subscribe = self._tell_newcomer
        self._publisher.impl.add_subscriber_listener(listener)
        self._one_at_a_time = asyncio.Lock()
        self._steps: set[asyncio.Future[Any]] = set()  # and other calls on time that have not ended

    async def carry_out(self, method: Method, session: Session, params: Params) -> Any:
        """Publish a call, carry it out and return its result; its errors are the caller's."""
        if method.touches == "nothing":
            self._publish(method, session, params, Instant())
            return await invoke(method, session, params)
        if method.touches == "time":  # waits for no action: a pause ends a step that hangs
            self._publish(method, session, params, Instant())
            step = asyncio.ensure_future(invoke(method, session, params))
            self._steps.add(step)
            step.add_done_callback(self._steps.discard)
            return await step
        async with self._one_at_a_time:
            number, call = await self._begin(method, session, params)
        try:
            return await call
        except Exception:
            self._mark(REFUSED, number)
            raise

    async def _begin(self, method: Method, session: Session, params: Params) -> tuple[int, asyncio.Future[Any]]:
        """Start a call while time stands still; return its number and its task when it has ended or takes too long."""
        if self._steps:
            await asyncio.wait(self._steps, timeout=_SHORT_STEP)
        instant = await self._context.blocking(hold, self._context.master, is_stepping=bool(self._steps))
        try:
            recorded = params if method.recorded is None else method.recorded(params)
            number = self._publish(method, session, recorded, instant)
            call = asyncio.ensure_future(invoke(method, session, params))
            await asyncio.wait({call}, timeout=_LONGEST_ACTION if instant.held else 0.0)
            if instant.held and not call.done():
                self._mark(LET_GO, number)
        finally:
            await self._context.blocking(let_go, instant)
        return number, call

    def _publish(self, method: Method, session: Session, params: Params, instant: Instant) -> int:
        on_flight = method.touches == "flight"
        self._number += on_flight
        self._tell(
            {
                "station": self.station,
                "number": self._number if on_flight else 0,
                "tick": instant.tick,
                "time": instant.time,
                "held": instant.held,
                "page": session.number,
                "method": method.name,
                "params": params,
            },
            keep=on_flight,
        )
        if method.touches != "nothing":
            self._tell_others(session, in_words(method.name, params))
        return self._number

    def _tell_others(self, session: Session, words: str) -> None:
        """Tell the other pages what this one does; its number is that of the topic's ``page``."""
        for other in list(self._context.sessions.values()) if words else ():
            if other is not session:
                other.push("actions.other", {"page": session.number, "text": words})

    def _mark(self, mark: str, number: int) -> None:
        """Publish how an action on the flight has ended, ``LET_GO`` or ``REFUSED``."""
        self._tell({"station": self.station, "method": mark, "params": {"number": number}}, keep=True)

    def _tell(self, content: Mapping[str, Any], *, keep: bool) -> None:
        message = String(json.dumps(content, sort_keys=True))
        if keep and len(self._so_far) < _KEPT and self._so_far_text + len(message.data) <= _KEPT_TEXT:
            self._so_far.append(message)
            self._so_far_text += len(message.data)
        self._publisher.publish(message)

    def _tell_newcomer(self, _topic: str, _publish: Any, publish_to: Callable[[String], None]) -> None:
        for message in list(self._so_far):
            publish_to(message)


def in_words(method: str, params: Mapping[str, Any]) -> str:
    """Return the notice of an action, as ``takeoff: iris_0, iris_1``; empty for one of which the other pages get none.

    Args:
        method: name, as ``vehicles.command``.
        params: as the page has sent them; they may be of any kind.
    """
    if method in _SILENT:
        return ""
    what = next((str(params[key]) for key in ("action", "text") if params.get(key)), method.replace(".", " "))
    if what == "speed":
        what = f"speed {params.get('factor')}"
    whom = _names(params)
    return f"{what}: {whom}"[:_LONGEST_NOTICE] if whom else what[:_LONGEST_NOTICE]


def _names(params: Mapping[str, Any]) -> str:
    for key in ("vehicles", "files"):
        named = params.get(key)
        if isinstance(named, (list, dict)) and named:
            names = [str(name) for name in named]
            more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
            return f"{', '.join(names[:_MOST_NAMES])}{more}"
    return next((str(params[key]) for key in ("target", "vehicle", "topic", "name") if params.get(key)), "")
