"""Methods that a page may call over its WebSocket."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from xtdrone_interaction.web.server.credentials import Role
from xtdrone_interaction.web.server.session import Session

Params = Mapping[str, Any]
Touches = Literal["flight", "time", "nothing"]
"""Effect of a call of role ``operate``: on the flight, on the progress of simulated time, or on neither."""


class CallError(ValueError):
    """A call that cannot be carried out; the text goes to the page."""


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes:
        name: as ``fleet.roster``: the room, and what it does there.
        call: function of the session and the parameters, or a coroutine function; returns what JSON can hold. Its
            ``ValueError`` is the answer to the page. It runs in the event loop and must not block.
        role: needed to call it; the calls of ``operate`` are published as operator actions.
        touches: effect of a call of ``operate``; one on the flight takes effect between two ticks.
        recorded: returns what is published in place of the parameters, so that a replay needs nothing else.
    """

    name: str
    call: Callable[[Session, Params], Any | Awaitable[Any]]
    role: Role = "view"
    touches: Touches = "flight"
    recorded: Callable[[Params], Params] | None = None


class MethodTable:
    """All methods of a station, by name."""

    def __init__(self, methods: Iterable[Method]) -> None:
        """Join the methods of all rooms.

        Raises:
            ValueError: two methods have the same name.
        """
        self._methods: dict[str, Method] = {}
        for method in methods:
            if method.name in self._methods:
                raise ValueError(f"method: {method.name!r} is declared twice")
            self._methods[method.name] = method

    def find(self, name: object, role: Role) -> Method:
        """Return the method of a name that a role may call.

        Raises:
            CallError: there is none, or the role does not suffice.
        """
        method = self._methods.get(name) if isinstance(name, str) else None
        if method is None:
            raise CallError(f"method: {str(name)[:80]!r} is not allowed, one of {', '.join(sorted(self._methods))}")
        if method.role == "operate" and role != "operate":
            raise CallError(f"method: {method.name} is not allowed to this page, which may only watch")
        return method


async def invoke(method: Method, session: Session, params: Params) -> Any:
    """Return a method's result, whether it is a coroutine function or not."""
    result = method.call(session, params)
    return await result if inspect.isawaitable(result) else result


def checked_params(params: object) -> dict[str, Any]:
    """Return the parameters of a call.

    Raises:
        CallError: they are not an object.
    """
    if params is None:
        return {}
    if not isinstance(params, dict):
        raise CallError(f"params: {type(params).__name__} is not allowed, an object with the method's parameters")
    return params


def needed(params: Params, name: str, kind: type | tuple[type, ...], allowed: str) -> Any:
    """Return a parameter of a type.

    Raises:
        CallError: it is missing or of another type.
    """
    value = params.get(name)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise CallError(f"{name}: {str(value)[:80]!r} is not allowed, {allowed}")
    return value
