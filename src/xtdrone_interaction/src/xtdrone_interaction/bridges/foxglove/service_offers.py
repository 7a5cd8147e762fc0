"""The services of the graph for Foxglove's clients, requests and responses in ROS 1's serialisation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from foxglove import MessageSchema, Service, ServiceRequest, ServiceSchema

from xtdrone_interaction.bridges.foxglove.topic_channels import ENCODING, schema_of
from xtdrone_interaction.bridges.ros_services import Services
from xtdrone_interaction.bridges.ros_types import ServiceTypeError, service_class
from xtdrone_interaction.service_client import ServiceError
from xtdrone_interaction.topics.message_classes import decode

MAX_SERVICES = 3000


def offered(name: str, type_: str, call: Callable[[ServiceRequest], bytes]) -> Service:
    """Return a service for the server.

    Raises:
        ServiceTypeError: its type is not installed.
    """
    kind = service_class(type_)
    request, response = kind._request_class, kind._response_class
    schema = ServiceSchema(
        type_,
        request=MessageSchema(encoding=ENCODING, schema=schema_of(request, f"{type_}_Request")),
        response=MessageSchema(encoding=ENCODING, schema=schema_of(response, f"{type_}_Response")),
    )
    return Service(name, schema=schema, handler=call)


class ServiceOffers:
    """Keeps the server's services in step with the graph."""

    def __init__(self, services: Services, server: Any, limit: float, report: Callable[[str, str], None]) -> None:
        """Initialise without services.

        Args:
            services: of the graph.
            server: the WebSocket server.
            limit: timeout of a response, s.
            report: sends clients a warning; called with an identifier and a text.
        """
        self._services = services
        self._server = server
        self._limit = limit
        self._report = report
        self._offered: dict[str, str] = {}
        self._refused: set[tuple[str, str]] = set()

    def update(self, names: Mapping[str, Any]) -> None:
        """Add and remove services; query the types of new ones."""
        self._services.refresh(names)
        types = self._services.types
        gone = [name for name, type_ in self._offered.items() if types.get(name) != type_]
        if gone:
            self._server.remove_services(gone)
        for name in gone:
            del self._offered[name]
        made = [self._made(name, type_) for name, type_ in types.items() if name not in self._offered]
        new = [service for service in made if service is not None][: MAX_SERVICES - len(self._offered)]
        if new:
            self._server.add_services(new)
            self._offered |= {service.name: types[service.name] for service in new}

    def _made(self, name: str, type_: str) -> Service | None:
        if (name, type_) in self._refused:
            return None
        try:
            return offered(name, type_, lambda request: self._call(name, type_, request))
        except ServiceTypeError as error:
            self._refused.add((name, type_))
            self._report(f"service {name}", f"service: {name} is not offered: {error}")
            return None

    def _call(self, name: str, type_: str, request: ServiceRequest) -> bytes:
        """Call a service for a client; runs in a thread of the SDK, which reports exceptions to the client."""
        if request.encoding != ENCODING:
            raise ServiceError(f"{name}: encoding {request.encoding!r} is not allowed, {ENCODING}")
        kind = service_class(type_)
        decode(kind._request_class, request.payload)  # raises for malformed requests
        return self._services.call_with_bytes(name, kind, request.payload, self._limit)
