"""The services ``/rosapi/...``, which rosbridge clients expect, answered by the server itself.

Names and fields are those of the package rosapi of rosbridge_suite (branch ros1); each service is a function of its
arguments that returns the response's fields.
"""

from __future__ import annotations

import fnmatch
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import genmsg.msgs
import genpy

from xtdrone_interaction.bridges.ros_types import ServiceTypeError, service_class
from xtdrone_interaction.bridges.rosbridge.protocol.operations import shown
from xtdrone_interaction.parameter_secrets import is_secret, without_secrets
from xtdrone_interaction.topics.discovery import UNKNOWN_TYPE, Topic, TopicGraph
from xtdrone_interaction.topics.message_classes import MessageTypeError, class_of_field, installed_class
from xtdrone_interaction.topics.ros_names import RosNameError, absolute_name

PREFIX = "/rosapi/"
_EXAMPLES = {"bool": "False", "string": "", "float32": "0.0", "float64": "0.0", "time": "0", "duration": "0"}
_CHANGES = {"set_param", "delete_param"}
"""Services that modify the system."""
Fields = Mapping[str, Any]


class RosapiError(ValueError):
    """A call that cannot be answered; the message gives the reason."""


class Parameters(Protocol):
    """The methods of the parameter server in use, as in ``rosgraph.Master``."""

    def getParam(self, key: str) -> Any:  # noqa: N802
        """Return a parameter."""

    def setParam(self, key: str, value: Any) -> None:  # noqa: N802
        """Set a parameter."""

    def hasParam(self, key: str) -> bool:  # noqa: N802
        """Return whether a parameter is set."""

    def deleteParam(self, key: str) -> None:  # noqa: N802
        """Delete a parameter."""

    def searchParam(self, key: str) -> str:  # noqa: N802
        """Return the full name of a parameter, searched upwards."""

    def getParamNames(self) -> list[str]:  # noqa: N802
        """Return all names."""


class Rosapi:
    """Answers calls of ``/rosapi/...``."""

    def __init__(
        self,
        graph: Callable[[], TopicGraph],
        service_type: Callable[[str], str],
        parameters: Parameters,
        params: Sequence[str],
        now: Callable[[], tuple[int, int]],
        operate: bool,
    ) -> None:
        """Initialise.

        Args:
            graph: returns the current graph.
            service_type: returns the type of a service, empty if it is unknown.
            parameters: the parameter server.
            params: shell patterns of the parameters that clients may use.
            now: returns the ROS time, s and ns.
            operate: whether clients may change parameters.
        """
        self._graph = graph
        self._service_type = service_type
        self._parameters = parameters
        self._params = tuple(params)
        self._now = now
        self._operate = operate
        self._services: dict[str, Callable[[Fields], Fields]] = {
            "topics": self._topics,
            "topics_and_raw_types": self._topics_and_raw_types,
            "topics_for_type": lambda a: {"topics": _with_type(self._types(), _text(a, "type"))},
            "topic_type": lambda a: {"type": self._types().get(_name(a, "topic"), "")},
            "publishers": lambda a: {"publishers": list(self._topic(a).publishers)},
            "subscribers": lambda a: {"subscribers": list(self._topic(a).subscribers)},
            "services": lambda _: {"services": sorted(self._graph().services)},
            "services_for_type": self._services_for_type,
            "service_type": lambda a: {"type": self._service_type(_name(a, "service"))},
            "service_node": lambda a: {"node": next(iter(self._graph().services.get(_name(a, "service"), ())), "")},
            "service_providers": self._service_providers,
            "nodes": lambda _: {"nodes": self._graph().nodes},
            "node_details": self._node_details,
            "action_servers": lambda _: {"action_servers": self._action_servers()},
            "get_param_names": lambda _: {"names": [n for n in self._parameters.getParamNames() if self._is_open(n)]},
            "get_param": self._get_param,
            "set_param": self._set_param,
            "has_param": lambda a: {"exists": self._parameters.hasParam(self._param(a))},
            "delete_param": self._delete_param,
            "search_param": self._search_param,
            "get_time": lambda _: {"time": dict(zip(("secs", "nsecs"), self._now(), strict=True))},
            "message_details": lambda a: {"typedefs": type_definitions(_message(_text(a, "type")))},
            "service_request_details": lambda a: {"typedefs": type_definitions(_service(a)._request_class)},
            "service_response_details": lambda a: {"typedefs": type_definitions(_service(a)._response_class)},
        }

    @property
    def names(self) -> list[str]:
        """The services' names."""
        return [f"{PREFIX}{name}" for name in self._services]

    def call(self, service: str, arguments: Fields) -> Fields:
        """Return the fields of the response.

        Args:
            service: a name under ``/rosapi/``.
            arguments: fields of the request.

        Raises:
            RosNameError: a name in the arguments is not allowed.
            RosapiError: an unknown service, arguments that are not allowed, or a parameter server that rejects them.
        """
        name = service.removeprefix(PREFIX)
        function = self._services.get(name)
        if function is None:
            raise RosapiError(f"service: {service!r} does not exist, {PREFIX} with {', '.join(self._services)}")
        if name in _CHANGES and not self._operate:
            raise RosapiError(f"{service}: this bridge is read-only, see its parameter operate")
        try:
            return function(arguments)
        except (RosapiError, RosNameError):
            raise
        except Exception as error:  # rosgraph.MasterError, or any error of a broken XML-RPC exchange
            raise RosapiError(f"{service}: {error}") from error

    def _types(self) -> dict[str, str]:
        """Return the type of each topic, empty if it is unknown."""
        topics = self._graph().topics.values()
        return {topic.name: "" if topic.type == UNKNOWN_TYPE else topic.type for topic in topics}

    def _topic(self, arguments: Fields) -> Topic:
        name = _name(arguments, "topic")
        return self._graph().topics.get(name, Topic(name, UNKNOWN_TYPE))

    def _topics(self, _: Fields) -> Fields:
        types = self._types()
        return {"topics": list(types), "types": list(types.values())}

    def _topics_and_raw_types(self, _: Fields) -> Fields:
        types = self._types()
        return {
            "topics": list(types),
            "types": list(types.values()),
            "typedefs_full_text": [_full_text(type_) for type_ in types.values()],
        }

    def _services_for_type(self, arguments: Fields) -> Fields:
        wanted = _text(arguments, "type")
        return {"services": [name for name in sorted(self._graph().services) if self._service_type(name) == wanted]}

    def _service_providers(self, arguments: Fields) -> Fields:
        nodes = self._graph().services.get(_name(arguments, "service"), ())
        return {"providers": list(nodes)}

    def _node_details(self, arguments: Fields) -> Fields:
        node, graph = _name(arguments, "node"), self._graph()
        return {
            "publishing": [topic.name for topic in graph.topics.values() if node in topic.publishers],
            "subscribing": [topic.name for topic in graph.topics.values() if node in topic.subscribers],
            "services": [name for name, nodes in graph.services.items() if node in nodes],
        }

    def _action_servers(self) -> list[str]:
        """Return the names of actions: those with a topic ``goal`` of a type ...ActionGoal."""
        types = self._types().items()
        return [name.removesuffix("/goal") for name, t in types if name.endswith("/goal") and t.endswith("ActionGoal")]

    def _get_param(self, arguments: Fields) -> Fields:
        name = "/" if arguments.get("name") == "/" and self._is_open("/") else self._param(arguments)
        if not self._parameters.hasParam(name):
            return {"value": str(arguments.get("default", ""))}
        return {"value": json.dumps(without_secrets(self._parameters.getParam(name)), default=str)}

    def _set_param(self, arguments: Fields) -> Fields:
        name, text = self._param(arguments), _text(arguments, "value")
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = text
        self._parameters.setParam(name, value)
        return {}

    def _delete_param(self, arguments: Fields) -> Fields:
        self._parameters.deleteParam(self._param(arguments))
        return {}

    def _search_param(self, arguments: Fields) -> Fields:
        absolute_name(arguments.get("name"), "name")
        found = self._parameters.searchParam(arguments["name"]) or ""
        return {"global_name": found if self._is_open(found) else ""}

    def _param(self, arguments: Fields) -> str:
        name = absolute_name(arguments.get("name"), "name")
        if not self._is_open(name):
            raise RosapiError(f"name: {name!r} is not allowed, {', '.join(self._params)}, without tokens")
        return name

    def _is_open(self, name: str) -> bool:
        return not is_secret(name) and any(fnmatch.fnmatchcase(name, pattern) for pattern in self._params)


def type_definitions(kind: Any) -> list[Fields]:
    """Return the definitions of a message class and of the types that it contains, as in rosapi/TypeDef."""
    found: dict[str, Fields] = {}
    waiting = [kind]
    while waiting:
        message = waiting.pop(0)
        if message._type in found:
            continue
        types = [genmsg.msgs.parse_type(type_) for type_ in message._slot_types]
        parts = [base for base, _, _ in types]
        found[message._type] = {
            "type": message._type,
            "fieldnames": list(message.__slots__),
            "fieldtypes": parts,
            "fieldarraylen": [(length or 0) if is_array else -1 for _, is_array, length in types],
            "examples": [_example(base, is_array) for base, is_array, _ in types],
            **_constants(message),
        }
        waiting += [class_of_field(message, base) for base in parts if "/" in base]
    return list(found.values())


def _constants(message: Any) -> Fields:
    names = [name for name in vars(message) if name.isupper() and not isinstance(vars(message)[name], property)]
    plain = [name for name in names if isinstance(vars(message)[name], (bool, int, float, str))]
    return {"constnames": plain, "constvalues": [str(vars(message)[name]) for name in plain]}


def _example(base: str, is_array: bool) -> str:
    if is_array:
        return "[]"
    return "{}" if "/" in base else _EXAMPLES.get(base, "0")


def _full_text(type_: str) -> str:
    try:
        return str(installed_class(type_)._full_text)
    except MessageTypeError:
        return ""


def _message(type_: str) -> type[genpy.Message]:
    try:
        return installed_class(type_)
    except MessageTypeError as error:
        raise RosapiError(str(error)) from error


def _service(arguments: Fields) -> Any:
    try:
        return service_class(_text(arguments, "type"))
    except ServiceTypeError as error:
        raise RosapiError(str(error)) from error


def _text(arguments: Fields, name: str) -> str:
    value = arguments.get(name)
    if not isinstance(value, str) or not value:
        raise RosapiError(f"{name}: {shown(value)} is not allowed, text")
    return value


def _name(arguments: Fields, name: str) -> str:
    return absolute_name(arguments.get(name), name)


def _with_type(types: Mapping[str, str], wanted: str) -> list[str]:
    return [name for name, type_ in types.items() if type_ == wanted]
