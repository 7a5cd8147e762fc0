"""The session of one client: executes its operations, and reports failures by status messages."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import genpy

from xtdrone_interaction.bridges.bridge_graph import BridgeGraph
from xtdrone_interaction.bridges.ros_publications import PublicationError, Publications
from xtdrone_interaction.bridges.ros_services import Services
from xtdrone_interaction.bridges.ros_types import ServiceTypeError, service_class
from xtdrone_interaction.bridges.rosbridge import rosapi
from xtdrone_interaction.bridges.rosbridge.clients.client_services import ClientServiceError, ClientServices
from xtdrone_interaction.bridges.rosbridge.clients.connection import Connection
from xtdrone_interaction.bridges.rosbridge.clients.subscriptions import Encoder, SubscriptionError, Subscriptions
from xtdrone_interaction.bridges.rosbridge.protocol.encodings import encode_json
from xtdrone_interaction.bridges.rosbridge.protocol.operations import LEVELS, Operation, OperationError, parse_operation
from xtdrone_interaction.service_client import ServiceError
from xtdrone_interaction.topics.discovery import MasterError
from xtdrone_interaction.topics.message_classes import MessageTypeError
from xtdrone_interaction.topics.message_json import MessageJsonError, NotFinite, from_json, to_json
from xtdrone_interaction.topics.raw_subscriptions import RawSubscriptions
from xtdrone_interaction.topics.ros_names import RosNameError, absolute_name

MAX_CALLS = 20
"""Maximum number of pending service calls of one client."""
_OPERATE = {"advertise", "publish", "call_service", "advertise_service"}
"""Operations that require permission to operate."""
_REFUSALS = (
    OperationError,
    RosNameError,
    PublicationError,
    SubscriptionError,
    ClientServiceError,
    MessageJsonError,
    MessageTypeError,
    ServiceTypeError,
    MasterError,
)
_CALL_REFUSALS = (
    RosNameError,
    ServiceError,
    ServiceTypeError,
    MessageJsonError,
    rosapi.RosapiError,
    OperationError,
)


@dataclass(frozen=True)
class Bridge:
    """Resources shared by all sessions.

    Attributes:
        graph: the ROS graph.
        raw: subscriptions.
        encoder: of the messages.
        publications: topics that clients publish.
        services: of the graph.
        rosapi: the services that the server answers itself.
        serve: ``rospy.Service``.
        calls: threads for service calls.
        call_limit: timeout of a service's response, s.
        operate: whether clients may publish, call services and set parameters.
        now: returns the ROS time, the stamp of headers that clients leave without one.
    """

    graph: BridgeGraph
    raw: RawSubscriptions
    encoder: Encoder
    publications: Publications
    services: Services
    rosapi: rosapi.Rosapi
    serve: Callable[[str, Any, Callable[[Any], Any]], Any]
    calls: Executor
    call_limit: float
    operate: bool
    now: Callable[[], genpy.Time]


class Session:
    """A client's session. ``handle`` is called in the order of the client's frames, ``close`` at any time."""

    def __init__(self, bridge: Bridge, connection: Connection) -> None:
        """Begin a session."""
        self._bridge = bridge
        self._connection = connection
        self._lock = threading.Lock()  # one operation at a time
        self._closed = False
        self._level = "error"
        self._waiting_calls = 0
        self.subscriptions = Subscriptions(
            bridge.raw, bridge.encoder, connection, lambda text: self.status("error", text)
        )
        self._services = ClientServices(bridge.serve, self._send, bridge.call_limit, bridge.now)
        self._handlers: Mapping[str, Callable[[Operation], None]] = {
            "subscribe": self._subscribe,
            "unsubscribe": lambda op: self.subscriptions.unsubscribe(absolute_name(op["topic"], "topic"), op.id),
            "advertise": self._advertise,
            "unadvertise": lambda op: bridge.publications.unadvertise(self, absolute_name(op["topic"], "topic")),
            "publish": self._publish,
            "call_service": self._call_service,
            "advertise_service": self._advertise_service,
            "unadvertise_service": lambda op: self._services.unadvertise(absolute_name(op["service"], "service")),
            "service_response": lambda op: self._services.answer(op.id, op["values"], op["result"]),
            "set_level": self._set_level,
        }

    def handle(self, frame: str | bytes) -> None:
        """Execute the operation in a frame; may wait for the ROS master, not for a service."""
        with self._lock:
            if not self._closed:
                self._carry_out(frame)

    def _carry_out(self, frame: str | bytes) -> None:
        operation = None
        try:
            operation = parse_operation(frame)
            if operation.op in _OPERATE and not self._bridge.operate and not _is_rosapi(operation):
                raise OperationError(f"{operation.op}: this bridge is read-only, see parameter operate", operation.id)
            self._handlers[operation.op](operation)
        except _REFUSALS as error:
            id_ = operation.id if operation is not None else getattr(error, "id", None)
            self.status("error", str(error), id_)

    def close(self) -> None:
        """Close the client's subscriptions, publications and services."""
        with self._lock:
            self._closed = True
            self.subscriptions.close()
            self._services.close()
            self._bridge.publications.leave(self)

    def status(self, level: str, text: str, id_: str | int | None = None) -> None:
        """Send a status message, if the client requested this level; may be called from any thread."""
        if LEVELS.index(level) <= LEVELS.index(self._level):
            self._send({"op": "status", "level": level, "msg": text, **({} if id_ is None else {"id": id_})})

    def _send(self, operation: Mapping[str, Any], compression: str = "none") -> None:
        self._connection.send(encode_json(operation, compression))

    def _set_level(self, operation: Operation) -> None:
        self._level = operation["level"]

    def _subscribe(self, operation: Operation) -> None:
        topic = self._open_topic(operation)
        known = self._bridge.graph.topic_type(topic)
        wanted = _short(operation["type"] or "")
        if known and wanted and known != wanted:
            raise SubscriptionError(f"topic: {topic} of type {wanted} is not allowed, it has the type {known}")
        self.subscriptions.subscribe(
            topic, operation.id, operation["throttle_rate"], operation["queue_length"], operation["compression"]
        )
        if not known:
            self.status("warning", f"topic: {topic} is not published yet", operation.id)

    def _open_topic(self, operation: Operation) -> str:
        topic = absolute_name(operation["topic"], "topic")
        if not self._bridge.graph.is_open(topic):
            raise OperationError(f"topic: {topic} is not offered by this bridge, see its parameter topics_glob")
        return topic

    def _advertise(self, operation: Operation) -> None:
        topic = self._open_topic(operation)
        self._bridge.publications.advertise(self, topic, _short(operation["type"]), latch=operation["latch"])

    def _publish(self, operation: Operation) -> None:
        topic = self._open_topic(operation)
        kind = self._bridge.publications.advertise(self, topic, "", latch=operation["latch"])
        self._bridge.publications.publish(topic, from_json(kind, operation["msg"], self._bridge.now()))

    def _advertise_service(self, operation: Operation) -> None:
        name = absolute_name(operation["service"], "service")
        if name in self._bridge.graph.read().services or name.startswith(rosapi.PREFIX):
            raise ClientServiceError(f"service: {name} is not allowed, a node offers it already")
        self._services.advertise(name, _short(operation["type"]))

    def _call_service(self, operation: Operation) -> None:
        if self._waiting_calls >= MAX_CALLS:
            self._answer(operation, f"{MAX_CALLS} calls of this client are pending", False)
            return
        self._waiting_calls += 1
        self._bridge.calls.submit(self._call, operation)

    def _call(self, operation: Operation) -> None:
        """Call a service and answer the client; runs in its own thread."""
        try:
            name = absolute_name(operation["service"], "service")
            if name.startswith(rosapi.PREFIX):
                values = self._bridge.rosapi.call(name, _fields(operation["args"], ()))
            else:
                values = self._called(name, operation)
            self._answer(operation, values, True)
        except _CALL_REFUSALS as error:
            self._answer(operation, str(error), False)
        except Exception as error:  # the response does not match its type, or the master is gone
            self._answer(operation, f"{operation['service']}: {error}", False)
        finally:
            self._waiting_calls -= 1

    def _called(self, name: str, operation: Operation) -> Any:
        kind = service_class(self._type_of(name, _short(operation["type"] or "")))
        fields = _fields(operation["args"], kind._request_class.__slots__)
        request = from_json(kind._request_class, fields, self._bridge.now())
        limit = self._bridge.call_limit
        if operation["timeout"]:
            limit = min(limit, float(operation["timeout"]))
        return to_json(self._bridge.services.call(name, kind, request, limit), not_finite=NotFinite.NULL)

    def _type_of(self, name: str, wanted: str) -> str:
        known = self._bridge.services.type_of(name)
        if not known:
            raise ServiceError(f"{name}: no such service on the ROS master")
        if wanted and wanted != known:
            raise ServiceError(f"{name} of type {wanted} is not allowed, it has the type {known}")
        return known

    def _answer(self, operation: Operation, values: Any, result: bool) -> None:
        response = {"op": "service_response", "service": operation["service"], "values": values, "result": result}
        if operation.id is not None:
            response["id"] = operation.id
        self._send(response, operation["compression"])


def _is_rosapi(operation: Operation) -> bool:
    return operation.op == "call_service" and f"/{operation['service'].strip('/')}".startswith(rosapi.PREFIX)


def _short(type_: str) -> str:
    """Return a type's name in ROS 1, also from its name in ROS 2."""
    return type_.replace("/msg/", "/").replace("/srv/", "/")


def _fields(arguments: Mapping[str, Any] | Sequence[Any], names: Sequence[str]) -> Mapping[str, Any]:
    """Return the fields of a request, which a client may also send as a list in order.

    Raises:
        OperationError: there are more values than fields.
    """
    if isinstance(arguments, Mapping):
        return arguments
    if len(arguments) > len(names):
        raise OperationError(f"args: {len(arguments)} values are not allowed, {', '.join(names) or 'none'}")
    return dict(zip(names, arguments, strict=False))
