"""Topic connections over Unix domain sockets: between nodes in lockstep on one machine, with rospy's own handshake.

A message costs a third of the kernel time that it costs over TCP. A connection is otherwise the same: rospy's
transport, header and counts. The subscriber numbers its connections; these numbers take the place of its TCP ports.
"""

from __future__ import annotations

import itertools
import os
import socket
import threading
from typing import Any

import rospy.core

from .. import unix_sockets
from .rospy_internals import accept_topic_connection, topic_server_address

LOCAL_HOST = "127.0.0.1"
HANDSHAKE_LIMIT = 10.0
"""Wall seconds for a publisher to accept a connection, and for its subscriber's header to arrive.

The publisher's header has no limit: rospy reads it without one, as over TCP.
"""
SEND_BUFFER = 1 << 20
"""Send buffer in bytes requested from the kernel (it may grant less) for messages that arrive between turns."""
HIGHEST_PORT = 65535

_token = os.urandom(8).hex()
_numbers = itertools.count()


def serve() -> None:
    """Accept topic connections beside the node's TCP port, in a thread, until the node is shut down."""
    host, port = topic_server_address()
    listener = unix_sockets.listen(unix_sockets.TOPICS, host, port)
    if listener is None:
        return
    rospy.core.add_shutdown_hook(lambda _: listener.shutdown(socket.SHUT_RDWR))
    threading.Thread(target=_accept, args=(listener,), name="lockstep topics", daemon=True).start()


def connect(connection: Any, host: str, port: int, publisher: str) -> bool:
    """Connect a subscriber's transport if the publisher is on this machine and in lockstep.

    Args:
        connection: rospy's TCPROSTransport.
        host: The publisher's host.
        port: The publisher's TCP port.
        publisher: URI of the publisher's node.

    Returns:
        Whether it is connected; otherwise it is unchanged.

    Raises:
        TransportInitError: The publisher refuses the connection.
        OSError: The publisher has ended in the meantime.
    """
    number = 1 + next(_numbers) % HIGHEST_PORT
    own = f"\0xtdrone-subscriber/{_token}-{os.getpid()}/{number}"  # the process may have been forked from another
    sock = unix_sockets.connect(unix_sockets.TOPICS, host, port, HANDSHAKE_LIMIT, own)
    if sock is None:
        return False
    connection.endpoint_id, connection.dest_address = publisher, (host, port)
    connection.socket = sock
    try:
        connection.write_header()
        connection.read_header()
    except BaseException:
        connection.socket = None
        sock.close()
        raise
    connection.local_endpoint = (LOCAL_HOST, number)
    connection.remote_endpoint = (host, port)
    return True


def _accept(listener: socket.socket) -> None:
    while True:
        try:
            accepted, address = listener.accept()
        except OSError:  # the node is shutting down
            listener.close()
            return
        sock = unix_sockets.LocalSocket(accepted.detach())
        number = _number(address)
        if number is None or not unix_sockets.has_same_owner(sock):
            sock.close()
            continue
        sock.settimeout(HANDSHAKE_LIMIT)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        accept_topic_connection(sock, (LOCAL_HOST, number))


def _number(address: object) -> int | None:
    """Return the number in a subscriber's address; None for any other address."""
    if not isinstance(address, bytes) or not address.startswith(b"\0xtdrone-subscriber/"):
        return None
    digits = address.rpartition(b"/")[2]
    number = int(digits) if digits.isdigit() and len(digits) <= 5 else 0
    return number if 0 < number <= HIGHEST_PORT else None
