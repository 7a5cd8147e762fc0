"""Services of the ROS graph for the bridges: their types, and calls with a time limit, outside the lockstep."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import urlparse

from xtdrone_interaction.service_client import ServiceError, call_service, call_with_bytes, probe

_PARALLEL = 8  # services probed at a time


def service_address(lookup: Callable[[str], str], name: str) -> tuple[str, int]:
    """Return host and port of a service.

    Args:
        lookup: ``rosgraph.Master.lookupService``.
        name: of the service.

    Raises:
        ServiceError: there is no such service.
    """
    try:
        address = urlparse(lookup(name))
        return str(address.hostname), int(address.port or 0)
    except Exception as error:  # rosgraph.MasterError, or any error of a broken XML-RPC exchange
        raise ServiceError(f"{name}: no such service on the ROS master") from error


class Services:
    """The services that a bridge offers to its clients.

    Attributes:
        types: type by name, as of the last ``refresh``.
    """

    def __init__(self, lookup: Callable[[str], str], caller: str, patterns: Sequence[str]) -> None:
        """Initialise without services.

        Args:
            lookup: ``rosgraph.Master.lookupService``.
            caller: name of the bridge's node.
            patterns: shell patterns of the services' names.
        """
        self._lookup = lookup
        self._caller = caller
        self._patterns = tuple(patterns)
        self.types: dict[str, str] = {}
        self._silent: set[str] = set()

    def is_offered(self, name: str) -> bool:
        """Return whether a pattern matches a service's name."""
        return any(fnmatch.fnmatchcase(name, pattern) for pattern in self._patterns)

    def refresh(self, names: Iterable[str]) -> None:
        """Determine the types of the current services; each one is queried once, even if it does not respond."""
        present = {name for name in names if self.is_offered(name)}
        self.types = {name: type_ for name, type_ in self.types.items() if name in present}
        self._silent &= present
        new = sorted(present - self.types.keys() - self._silent)
        if not new:
            return
        with ThreadPoolExecutor(_PARALLEL) as pool:
            found: Mapping[str, str] = dict(zip(new, pool.map(self.type_of, new), strict=True))
        self.types.update({name: type_ for name, type_ in found.items() if type_})
        self._silent.update(name for name, type_ in found.items() if not type_)

    def type_of(self, name: str) -> str:
        """Return the type of a service, empty if it does not respond."""
        if name in self.types:
            return self.types[name]
        try:
            return probe(service_address(self._lookup, name), name, self._caller).get("type", "")
        except ServiceError:
            return ""

    def call(self, name: str, kind: Any, request: Any, limit: float) -> Any:
        """Call a service and return its response; ``limit``: timeout, s.

        Raises:
            ServiceError: the service is not offered, does not exist, rejects the request, or does not respond.
        """
        return call_service(self._address(name), name, kind, request, self._caller, limit)

    def call_with_bytes(self, name: str, kind: Any, request: bytes, limit: float) -> bytes:
        """Call a service with a serialised request; return the serialised response; as ``call`` otherwise."""
        types = (kind._type, kind._md5sum)
        return call_with_bytes(self._address(name), name, types, request, self._caller, limit)

    def _address(self, name: str) -> tuple[str, int]:
        if not self.is_offered(name):
            raise ServiceError(f"{name}: not offered by this bridge, {', '.join(self._patterns)}")
        return service_address(self._lookup, name)
