"""Common parts of MAVROS's programs: arguments, service calls, topic messages and exit status."""

from __future__ import annotations

import argparse
import queue
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import genpy
import rosgraph
import rospy
from mavros_msgs.msg import State

from xtdrone_common.files import MOST_TEXT, ContentError, read_text, write_whole
from xtdrone_common.programs.plain_node import init_plain_node

DEFAULT_NAMESPACE = "mavros"
STANDARD = "-"
"""File name that selects standard input or output."""

_WALL_LIMIT = 30.0  # s; ROS time may stand still
_SLICE = 0.05  # s between reads of ROS time
_CONNECT_LIMIT = 3.0  # s of wall time for a topic's connection
_INTERRUPTED = 130
_RESULTS = (
    "accepted",
    "temporarily rejected",
    "denied",
    "unsupported",
    "failed",
    "in progress",
    "cancelled",
)  # MAV_RESULT

Handler = Callable[["Mavros", argparse.Namespace], None]


class ProgramError(Exception):
    """The requested action failed; the message is one line."""


def result_words(result: int) -> str:
    """Return a MAV_RESULT as number and name."""
    return f"{result} ({_RESULTS[result]})" if result < len(_RESULTS) else str(result)


class Subscription:
    """A subscription that queues its messages."""

    def __init__(self, topic: str, kind: type) -> None:
        """Subscribe.

        Args:
            topic: absolute topic name.
            kind: message type.
        """
        # Not SimpleQueue: Python 3.11's blocks forever if a signal handler runs longer than the timeout.
        self._messages: queue.Queue[Any] = queue.Queue()
        self._subscriber = rospy.Subscriber(topic, kind, self._messages.put, queue_size=100, tcp_nodelay=True)

    def connected(self) -> bool:
        """Wait for a publisher, at most 3 s; return whether there is one."""
        end = time.monotonic() + _CONNECT_LIMIT
        while not self._subscriber.get_num_connections():
            if time.monotonic() > end or rospy.is_shutdown():
                return False
            time.sleep(_SLICE)
        return True

    def next(self, limit: float | None, fits: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return the next message that fits, or None on timeout.

        Args:
            limit: timeout in s of wall time and of ROS time, whichever takes longer, at most 30 s of wall time, as ROS
                time may stand still; None: no timeout.
            fits: predicate that selects the messages.
        """
        begun, ros_begun = time.monotonic(), 0.0
        while not rospy.is_shutdown():
            try:
                message = self._messages.get(timeout=_SLICE)
            except queue.Empty:
                pass
            else:
                if fits(message):
                    return message
            waited = time.monotonic() - begun
            ros_begun = ros_begun or rospy.get_time()  # 0 until the first /clock
            if limit is not None and waited > limit and (waited > _WALL_LIMIT or rospy.get_time() - ros_begun > limit):
                return None
        return None

    def close(self) -> None:
        """Unsubscribe."""
        self._subscriber.unregister()


class Mavros:
    """The MAVROS instance that a program uses.

    Attributes:
        namespace: absolute, e.g. ``/iris_0/mavros``.
        verbose: print progress.
    """

    def __init__(self, namespace: str, verbose: bool = False) -> None:
        """Set the namespace.

        Args:
            namespace: Namespace, with or without the leading slash.
            verbose: print progress.
        """
        self.namespace = "/" + namespace.strip("/")
        self.verbose = verbose

    def topic(self, name: str) -> str:
        """Return the absolute name of a MAVROS topic, service or parameter."""
        return f"{self.namespace}/{name}"

    def note(self, text: str) -> None:
        """Print a line if the program is verbose."""
        if self.verbose:
            print(text, flush=True)

    def call(self, service: str, kind: Any, **fields: Any) -> Any:
        """Call a MAVROS service.

        Raises:
            ProgramError: the service is not offered or does not answer, or a field does not fit into its type.
        """
        name = self.topic(service)
        if not _is_offered(name):
            raise ProgramError(f"service {name} is not offered{_advice(self.namespace)}")
        try:
            return rospy.ServiceProxy(name, kind)(**fields)
        except (genpy.SerializationError, rospy.ROSSerializationException) as error:
            raise ProgramError(f"{service}: a value is not allowed: {_line(error)}") from error
        except (rospy.ROSException, rospy.ServiceException) as error:
            raise ProgramError(f"{name}: {_line(error)}") from error

    def command(self, service: str, kind: Any, **fields: Any) -> None:
        """Call a service whose response reports the autopilot's acknowledgement.

        Raises:
            ProgramError: as for :meth:`call`, or the command was not accepted.
        """
        answer = self.call(service, kind, **fields)
        if not answer.success:
            detail = f", MAV_RESULT {result_words(answer.result)}" if hasattr(answer, "result") else ""
            raise ProgramError(f"{service}: the vehicle has not accepted the command{detail}; see MAVROS's log")
        self.note(f"Command ACK: {getattr(answer, 'result', 0)}")

    def subscribe(self, topic: str, kind: type) -> Subscription:
        """Subscribe to a MAVROS topic."""
        return Subscription(self.topic(topic), kind)

    def wait_connected(self) -> None:
        """Wait, without a timeout, until MAVROS is connected to the vehicle.

        Raises:
            ProgramError: the program was interrupted.
        """
        subscription = self.subscribe("state", State)
        connected = subscription.next(None, lambda state: state.connected)
        subscription.close()
        if connected is None:
            raise ProgramError("interrupted while waiting for the vehicle's connection")


def new_parser(description: str) -> argparse.ArgumentParser:
    """Return a parser with the arguments common to all programs."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "-n", "--mavros-ns", default=DEFAULT_NAMESPACE, help="MAVROS's namespace, such as iris_0/mavros (%(default)s)"
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="print progress")
    parser.add_argument("--wait", action="store_true", help="wait until MAVROS is connected to the vehicle")
    return parser


def execute(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> None:
    """Execute a command line; the process is already a ROS node.

    Raises:
        ProgramError: the requested action failed.
        SystemExit: the command line is invalid, or requests help.
    """
    found = parser.parse_args(arguments)
    mavros = Mavros(found.mavros_ns, found.verbose)
    if found.wait:
        mavros.wait_connected()
    found.run(mavros, found)


def main(name: str, parser: argparse.ArgumentParser) -> int:
    """Run a program with the process's arguments; return its exit status.

    0: success; 1: failure, with the reason on standard error; 2: invalid command line.
    """
    arguments = rospy.myargv(sys.argv)[1:]
    parser.prog = name
    parser.parse_args(arguments)  # reports an invalid command line or --help without a master
    try:
        if not rosgraph.is_master_online():
            raise ProgramError(f"no ROS master answers at {rosgraph.get_master_uri()}: start a launch file first")
        init_plain_node(name, anonymous=True)
        execute(parser, arguments)
    except ProgramError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, rospy.ROSInterruptException):
        return _INTERRUPTED
    return 0


def read_file(name: str) -> str:
    r"""Return the text of a file, or of standard input for ``-``, with line endings converted to ``\n``.

    Raises:
        ProgramError: the file cannot be read, or is too large.
    """
    if name == STANDARD:
        text = sys.stdin.read(MOST_TEXT + 1)
        if len(text) > MOST_TEXT:
            raise ProgramError(f"standard input: more than {MOST_TEXT >> 20} MB are not allowed")
        return text
    try:
        return read_text(name)
    except (OSError, ContentError) as error:
        _refuse_file(name, "read", error)


def write_file(name: str, text: str) -> None:
    """Write a file, or to standard output for ``-``.

    Raises:
        ProgramError: the file cannot be written.
    """
    if name == STANDARD:
        sys.stdout.write(text)
        return
    try:
        write_whole(name, text)
    except OSError as error:
        _refuse_file(name, "written", error)


def _refuse_file(name: str, done: str, error: Exception) -> NoReturn:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    raise ProgramError(f"{name}: cannot be {done}: {reason}") from error


def _is_offered(service: str) -> bool:
    try:
        rosgraph.Master(rospy.get_name()).lookupService(service)
    except (rosgraph.MasterError, OSError):
        return False
    return True


def _advice(namespace: str) -> str:
    """Return a hint that lists the existing MAVROS namespaces if ``namespace`` has no MAVROS."""
    states = [name for name, kind in rospy.get_published_topics() if kind == State._type]
    found = sorted(name.removesuffix("/state") for name in states if name.endswith("/state"))
    if namespace in found:
        return " by this MAVROS"
    named = ", ".join(name.strip("/") for name in found[:8]) + ", ..." * (len(found) > 8)
    return f"; name a MAVROS by -n: {named}" if found else "; no MAVROS is running"


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
