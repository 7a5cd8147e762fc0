"""Services that a client offers: a call from the graph is forwarded to the client, whose answer is returned."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import genpy

from xtdrone_interaction.bridges.ros_types import ServiceTypeError, service_class
from xtdrone_interaction.topics.message_json import MessageJsonError, NotFinite, from_json, to_json

MAX_SERVICES = 50
"""Maximum number of services offered by one client."""
MAX_CALLS = 50
"""Maximum number of pending calls of a client's service."""


class ClientServiceError(ValueError):
    """A service that cannot be offered, or a call of it that has failed."""


@dataclass
class _Call:
    """A call that waits for the client."""

    kind: Any
    answered: threading.Event = field(default_factory=threading.Event)
    response: Any = None
    error: str = "the client has left"


class ClientServices:
    """The services of one client."""

    def __init__(
        self,
        serve: Callable[[str, Any, Callable[[Any], Any]], Any],
        send: Callable[[dict[str, Any]], None],
        limit: float,
        now: Callable[[], genpy.Time],
    ) -> None:
        """Initialise without services.

        Args:
            serve: ``rospy.Service``, or another function of name, class and handler.
            send: sends an operation to the client.
            limit: timeout of the client's answer, s.
            now: returns the ROS time, the stamp of headers that the client leaves without one.
        """
        self._now = now
        self._serve = serve
        self._send = send
        self._limit = limit
        self._services: dict[str, Any] = {}
        self._calls: dict[str, _Call] = {}
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()

    def advertise(self, name: str, type_: str) -> None:
        """Offer a service in the graph.

        Raises:
            ClientServiceError: the type is unknown, the name is in use here, or there are too many services.
        """
        if name in self._services:
            raise ClientServiceError(f"service: {name} is already offered")
        if len(self._services) >= MAX_SERVICES:
            raise ClientServiceError(f"service: {name} is one too many, at most {MAX_SERVICES} for a client")
        try:
            kind = service_class(type_)
        except ServiceTypeError as error:
            raise ClientServiceError(f"service: {name}: {error}") from error
        try:
            self._services[name] = self._serve(name, kind, lambda request: self._ask(name, kind, request))
        except Exception as error:  # rospy.service.ServiceException: this node already offers it
            raise ClientServiceError(f"service: {name}: {error}") from error

    def unadvertise(self, name: str) -> None:
        """End a service.

        Raises:
            ClientServiceError: the client does not offer it.
        """
        service = self._services.pop(name, None)
        if service is None:
            raise ClientServiceError(f"service: {name} is not offered by this client")
        service.shutdown("its client has withdrawn it")

    def answer(self, id_: object, values: Any, result: bool) -> None:
        """Handle a client's response.

        Args:
            id_: of the call.
            values: the response's fields, or an error text if ``result`` is false.
            result: whether the call has succeeded.

        Raises:
            ClientServiceError: no call waits for it, or the response does not match the type.
        """
        with self._lock:
            call = self._calls.pop(str(id_), None)
        if call is None:
            raise ClientServiceError(f"id: no pending call has the id {id_!r}")
        call.error = f"the client answers: {values}"
        try:
            call.response = from_json(call.kind._response_class, values, self._now()) if result else None
        except MessageJsonError as error:
            call.error = str(error)
            raise ClientServiceError(f"values: {error}") from error
        finally:
            call.answered.set()

    def close(self) -> None:
        """End all services and calls."""
        for name in list(self._services):
            self.unadvertise(name)
        with self._lock:
            calls, self._calls = list(self._calls.values()), {}
        for call in calls:
            call.answered.set()

    def _ask(self, name: str, kind: Any, request: Any) -> Any:
        """Return the client's response to a call; rospy reports exceptions to the caller."""
        call = _Call(kind)
        with self._lock:
            if len(self._calls) >= MAX_CALLS:
                raise ClientServiceError(f"{MAX_CALLS} calls of the client's services are pending")
            id_ = f"service_request:{name}:{next(self._numbers)}"
            self._calls[id_] = call
        values = to_json(request, not_finite=NotFinite.NULL)
        self._send({"op": "call_service", "id": id_, "service": name, "args": values})
        if not call.answered.wait(self._limit):
            call.error = f"the client has not answered within {self._limit:g} s"
        with self._lock:
            self._calls.pop(id_, None)
        if call.response is None:
            raise ClientServiceError(call.error)
        return call.response
