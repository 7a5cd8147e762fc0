"""Client for ROS services over TCPROS with timeouts, which rospy's client lacks, and without rospy.

Source of the protocol: wiki.ros.org, ROS/TCPROS and ROS/Connection Header.
"""

from __future__ import annotations

import contextlib
import io
import re
import socket
import struct
from collections.abc import Iterator
from typing import Any

import genpy
import rosgraph.network

CONNECTION_LIMIT = 3.0  # s for the connection and its headers
_HEADER_SIZE = 1 << 16  # bytes of an answered header
_PIECE = 1 << 20  # bytes received at a time
_MAX_RESPONSE = 1 << 28  # bytes
_ERROR = re.compile(r"^service \[.*?\] responded with an error: ")


class ServiceError(RuntimeError):
    """A service does not respond, or rejects a request; the message names the service."""


class ServiceRefusedError(ServiceError):
    """A service rejects a request; the message is the service's."""


def call_service(address: tuple[str, int], name: str, kind: Any, request: Any, caller: str, limit: float | None) -> Any:
    """Call a service and return its response.

    Args:
        address: host and port of the service.
        name: of the service.
        kind: generated class of the service.
        request: an object of ``kind._request_class``.
        caller: name of the calling node.
        limit: timeout of the response, s; None: no timeout.

    Raises:
        ServiceError: it rejects the request (``ServiceRefusedError``), or does not respond.
    """
    with ServiceConnection(address, name, (kind._type, kind._md5sum), caller) as connection:
        return connection.call(kind, request, limit)


def call_with_bytes(
    address: tuple[str, int], name: str, kind: tuple[str, str], request: bytes, caller: str, limit: float | None
) -> bytes:
    """Call a service with a serialised request and return the serialised response.

    Args:
        kind: type and md5 sum of the service; the others as for ``call_service``.

    Raises:
        ServiceError: as for ``call_service``.
    """
    with ServiceConnection(address, name, kind, caller) as connection:
        return connection.call_with_bytes(request, limit)


class ServiceConnection:
    """A connection to a service for any number of calls; the service can tell when its process has ended."""

    def __init__(self, address: tuple[str, int], name: str, kind: tuple[str, str], caller: str) -> None:
        """Connect; see ``call_with_bytes`` for the arguments.

        Raises:
            ServiceError: it does not respond, or has another type.
        """
        self._address, self._name = address, name
        header = {"callerid": caller, "service": name, "type": kind[0], "md5sum": kind[1], "persistent": "1"}
        with self._errors(CONNECTION_LIMIT):
            self._sock = socket.create_connection(address, timeout=CONNECTION_LIMIT)
        try:
            with self._errors(CONNECTION_LIMIT):
                _greet(self._sock, name, header)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> ServiceConnection:
        """Return the connection."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()

    def call(self, kind: Any, request: Any, limit: float | None) -> Any:
        """Call the service and return its response; see ``call_service``.

        Raises:
            ServiceError: as there, or the response is malformed.
        """
        content = io.BytesIO()
        request.serialize(content)
        response = self.call_with_bytes(content.getvalue(), limit)
        try:
            return kind._response_class().deserialize(response)
        except genpy.DeserializationError as error:
            raise ServiceError(
                f"{self._name}: its response of {len(response)} bytes is no {kind._type}: {error}"
            ) from error

    def call_with_bytes(self, request: bytes, limit: float | None) -> bytes:
        """Call the service with a serialised request and return the serialised response.

        Raises:
            ServiceError: it rejects the request (``ServiceRefusedError``), or does not respond.
        """
        with self._errors(limit or 0.0):
            self._sock.sendall(struct.pack("<I", len(request)) + request)
            self._sock.settimeout(limit)
            return _response(self._sock, self._name)

    def close(self) -> None:
        """Close the connection."""
        self._sock.close()

    @contextlib.contextmanager
    def _errors(self, patience: float) -> Iterator[None]:
        try:
            yield
        except TimeoutError as error:
            raise ServiceError(f"{self._name} has not answered within {patience:g} s") from error
        except OSError as error:
            host, port = self._address
            raise ServiceError(f"{self._name} at {host}:{port} does not answer: {error}") from error


def probe(address: tuple[str, int], name: str, caller: str) -> dict[str, str]:
    """Return the connection header of a service, with ``type`` and ``md5sum``, without calling it.

    Raises:
        ServiceError: it does not respond.
    """
    header = {"probe": "1", "md5sum": "*", "callerid": caller, "service": name}
    try:
        with socket.create_connection(address, timeout=CONNECTION_LIMIT) as sock:
            return _greet(sock, name, header)
    except OSError as error:
        raise ServiceError(f"{name} at {address[0]}:{address[1]} does not answer: {error}") from error


def _greet(sock: socket.socket, name: str, header: dict[str, str]) -> dict[str, str]:
    """Exchange the connection headers; return that of the service."""
    rosgraph.network.write_ros_handshake_header(sock, header)
    try:
        answer: dict[str, str] = rosgraph.network.read_ros_handshake_header(sock, io.BytesIO(), _HEADER_SIZE)
    except rosgraph.network.ROSHandshakeException as error:
        raise ServiceError(f"{name}: {error}") from error
    if "error" in answer:
        raise ServiceError(f"{name}: {answer['error']}")
    return answer


def _response(sock: socket.socket, name: str) -> bytes:
    done, size = struct.unpack("<BI", _read(sock, 5))
    if size > _MAX_RESPONSE:
        raise ServiceError(f"{name}: a response of {size} bytes is not accepted, at most {_MAX_RESPONSE}")
    data = _read(sock, size)
    if not done:
        raise ServiceRefusedError(_ERROR.sub("", data.decode("utf-8", "replace")))
    return data


def _read(sock: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        piece = sock.recv(min(size - len(data), _PIECE))
        if not piece:
            raise ConnectionError("it closed the connection")
        data += piece
    return bytes(data)
