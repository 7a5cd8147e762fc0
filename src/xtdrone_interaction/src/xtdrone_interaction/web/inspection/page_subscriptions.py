"""Subscriptions of pages: numbered, bounded for each page, and ended with it."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from xtdrone_interaction.topics.raw_subscriptions import Listener, RawMessage, RawSubscriptions
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.server.methods import CallError
from xtdrone_interaction.web.server.session import Session

MOST_OF_A_PAGE = 64
MOST_RATE = 100.0  # Hz


class PageSubscriptions:
    """Opens and closes subscriptions for pages; subscribing waits for the ROS master, so it runs in a thread."""

    def __init__(self, context: StationContext, topics: RawSubscriptions) -> None:
        """Store the context that the rooms share."""
        self._context = context
        self._topics = topics
        self._numbers = itertools.count(1)
        self._open: dict[Session, dict[int, Listener | None]] = {}

    async def open(
        self, session: Session, topic: str, rate: float | None, callback: Callable[[int, RawMessage], None]
    ) -> int:
        """Subscribe to a topic for a page and return the subscription's number.

        Args:
            session: of the page.
            topic: name; it need not exist yet.
            rate: most messages per s; None for all.
            callback: called with the number and each message, in another thread.

        Raises:
            CallError: the page has too many, or the name or the rate is not allowed.
        """
        if rate is not None and not (isinstance(rate, (int, float)) and 0.0 < rate <= MOST_RATE):
            raise CallError(f"rate: {rate!r} is not allowed, more than 0, up to {MOST_RATE:g} Hz")
        if session not in self._open:
            self._open[session] = {}
            session.on_close(lambda: self._end(session))
        mine = self._open[session]
        if len(mine) >= MOST_OF_A_PAGE:
            raise CallError(f"topic: {topic!r} is not allowed, a page has at most {MOST_OF_A_PAGE} subscriptions")
        number = next(self._numbers)
        mine[number] = None
        try:
            listener = await self._context.blocking(
                self._topics.listen, topic, lambda message: callback(number, message), rate
            )
        except BaseException:
            mine.pop(number, None)
            raise
        if number in mine:
            mine[number] = listener
        else:  # the page has disconnected, or closed it, meanwhile
            await self._context.blocking(listener.close)
        return number

    async def close(self, session: Session, number: object) -> None:
        """End a subscription of a page; no effect if it has already ended."""
        listener = self._open.get(session, {}).pop(number, None) if isinstance(number, int) else None
        if listener is not None:
            await self._context.blocking(listener.close)

    def _end(self, session: Session) -> None:
        for listener in self._open.pop(session).values():
            if listener is not None:
                self._context.in_loop(self._context.blocking, listener.close)
