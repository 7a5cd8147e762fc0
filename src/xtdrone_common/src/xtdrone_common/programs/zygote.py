"""A process that has imported the modules of a launch's Python nodes and forks each node on request.

A fork starts in milliseconds and shares the memory of the modules with all other forks. ``node_launcher``, the
launch-prefix of the nodes, connects to the zygote of its roslaunch and stays as the process that roslaunch monitors in
place of the forked node. The first launcher starts the zygote, or it is started before roslaunch (``node_launcher
--ahead``) and then imports the modules of later nodes while no request is waiting.

A node runs as under the interpreter: same command line, environment, working directory, descriptors and signal
handlers, in a session of its own. The zygote imports the modules that the node's script imports at the top; the node
imports the rest.

No node outlives its launcher or the zygote. When roslaunch ends, the zygote interrupts the remaining nodes and ends. It
also ends some seconds after its last node, because a launcher whose roslaunch has been killed becomes a child of the
init process, which never ends. A later launcher starts another zygote.
"""

from __future__ import annotations

import array
import ast
import builtins
import contextlib
import ctypes
import gc
import importlib
import io
import os
import select
import signal
import socket
import struct
import sys
import threading
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_SIZES = struct.Struct("=II")  # bytes of the command line and of the environment
_REPLY = struct.Struct("=c3xi")
_MOST = 1 << 24  # bytes of a request
_LIMIT = 5.0  # s for a launcher to send its request
_PATIENCE = 10.0  # s for nodes to end after roslaunch has ended
_IDLE = 3.0  # s without a node
_FIRST_NODE = 60.0  # s from the start of roslaunch
_SET_BY_ROSLAUNCH = frozenset({"ROS_MASTER_URI", "ROS_LOG_FILENAME"})  # no module reads them on import
_DESCRIPTORS = 4  # of a request: standard input, output, error; working directory
_BLOCKED = {signal.SIGINT, signal.SIGTERM}  # blocked during a fork, so that a node receives them with its own handlers
_COMMON = ("xtdrone_lockstep.client.api", "logging.config", "rosgraph.roslogging")
_Peer = socket.socket


class NodeRequestError(Exception):
    """A malformed request."""


@dataclass(frozen=True)
class NodeRequest:
    """A node to run.

    Attributes:
        command: path of its script, and its arguments.
        environment: ``NAME=value``.
        descriptors: standard input, output and error, and its working directory; owned by the request.
    """

    command: list[bytes]
    environment: list[bytes]
    descriptors: list[int]

    def close(self) -> None:
        """Close the descriptors."""
        for descriptor in self.descriptors:
            os.close(descriptor)


@dataclass(frozen=True)
class _Node:
    """A forked node.

    Attributes:
        connection: Connection to its launcher.
        pid: process and session id.
        watch: pidfd, readable after its end.
    """

    connection: _Peer
    pid: int
    watch: int


def receive(connection: _Peer) -> NodeRequest:
    """Receive a launcher's request.

    Raises:
        NodeRequestError: it is malformed, or from another user.
        OSError: no request arrives in time.
    """
    peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    if struct.unpack("3i", peer)[1] != os.getuid():
        raise NodeRequestError("from another user")
    connection.settimeout(_LIMIT)
    data, descriptors = _first_part(connection)
    try:
        while len(data) < _SIZES.size or len(data) < _SIZES.size + sum(_SIZES.unpack_from(data)):
            part = connection.recv(1 << 16)
            if not part or len(data) > _MOST:
                raise NodeRequestError("incomplete or too long")
            data += part
        size, rest = _SIZES.unpack_from(data)
        words = data[_SIZES.size :]
        command, environment = words[:size], words[size : size + rest]
        if len(descriptors) != _DESCRIPTORS or not command.endswith(b"\0"):
            raise NodeRequestError("without a command or descriptors")
    except BaseException:
        for descriptor in descriptors:
            os.close(descriptor)
        raise
    connection.settimeout(None)
    return NodeRequest(command.split(b"\0")[:-1], environment.split(b"\0")[:-1], descriptors)


def _first_part(connection: _Peer) -> tuple[bytes, list[int]]:
    descriptors = array.array("i")
    space = socket.CMSG_SPACE(_DESCRIPTORS * descriptors.itemsize)
    data, ancillary, _, _ = connection.recvmsg(1 << 16, space, socket.MSG_CMSG_CLOEXEC)
    for level, kind, content in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            descriptors.frombytes(content[: len(content) - len(content) % descriptors.itemsize])
    return data, descriptors.tolist()


def imported_modules(script: Path) -> list[str]:
    """Return the modules that a script imports at the top, absolute imports only.

    For the relay of catkin's devel space these are those of the script it executes. Modules in the script's folder are
    left out: another script may import different ones of the same names.
    """
    tree = ast.parse(script.read_bytes())
    relayed = _relay_target(tree)
    if relayed:
        tree = ast.parse(Path(relayed).read_bytes())
    names = []
    for node in tree.body:
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return [name for name in names if not _is_beside(script, name.split(".")[0])]


def _relay_target(tree: ast.Module) -> str:
    """Return the path of the script that a relay of catkin executes; empty if ``script`` is not a relay."""
    for node in tree.body:
        match node:
            case ast.Assign(targets=[ast.Name(id="python_script")], value=ast.Constant(value=str(path))):
                return path
    return ""


def _is_beside(script: Path, name: str) -> bool:
    return (script.parent / name).is_dir() or (script.parent / f"{name}.py").exists()


@dataclass
class Zygote:
    """Forks nodes.

    Attributes:
        listener: where launchers connect.
        roslaunch: its process id.
        ahead: modules to import while no request is waiting, if the zygote was started before roslaunch.
        title: address and size of the memory with this process's command line.
    """

    listener: _Peer
    roslaunch: int
    ahead: Sequence[str]
    title: tuple[int, int]
    _nodes: dict[int, _Node] = field(default_factory=dict)  # by both descriptors
    _known: set[str] = field(default_factory=set)
    _environment: set[bytes] = field(default_factory=set)
    _forked: bool = False
    _interrupt: Any = signal.SIG_DFL
    _poll: select.poll = field(default_factory=select.poll)
    _spare: int = field(default_factory=lambda: os.open(os.devnull, os.O_RDONLY))

    def serve(self) -> Callable[[], None] | None:
        """Fork nodes until roslaunch has ended; in each node's process, return the function that runs the node."""
        # Restored: in the C locale the interpreter itself adds LC_CTYPE, as it will in each node.
        self._environment = set(Path("/proc/self/environ").read_bytes().split(b"\0")[:-1])
        self._interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
        watch = os.pidfd_open(self.roslaunch)
        if os.getppid() != self.roslaunch:
            return None
        gc.disable()  # importing creates no garbage worth an eighth of its time; each node enables it again
        self._prepare()
        self._poll.register(watch, select.POLLIN)
        self._poll.register(self.listener, select.POLLIN)
        self._import_ahead()
        roslaunch_runs = True
        while roslaunch_runs or self._nodes:
            ready = self._poll.poll(self._patience(roslaunch_runs))
            for descriptor, _ in ready:
                if descriptor == watch:
                    self._poll.unregister(watch)
                    self._interrupt_nodes()
                    roslaunch_runs = False
                elif descriptor == self.listener.fileno():
                    run = self._accept(watch)
                    if run is not None:
                        return run
                elif descriptor in self._nodes:
                    self._end(self._nodes[descriptor], descriptor)
            if not ready:
                break
        return None

    def _patience(self, roslaunch_runs: bool) -> float | None:
        """Return how long to wait for an event, ms, before the zygote ends; None to wait without limit."""
        if self._nodes:
            return None if roslaunch_runs else 1000.0 * _PATIENCE
        return 1000.0 * (_IDLE if self._forked or not self.ahead else _FIRST_NODE)

    def _accept(self, watch: int) -> Callable[[], None] | None:
        """Serve a launcher; without a reply it runs the node itself."""
        try:
            connection = self.listener.accept()[0]
        except OSError:  # too many open descriptors
            self._turn_away()
            return None
        try:
            request = receive(connection)
        except (NodeRequestError, OSError):
            connection.close()
            return None
        script = Path(os.fsdecode(request.command[0]))
        run = None
        if self._is_same(request.environment) and self._import(script):
            run = self._fork(request, script, connection, watch)
        else:
            _reply(connection, b"R", 0)
            connection.close()
        if run is None:
            request.close()
        return run

    def _is_same(self, environment: Sequence[bytes]) -> bool:
        """Return whether a node has the zygote's environment; before the first fork adopt what roslaunch has set."""
        new = set(environment)
        differing = {os.fsdecode(word.partition(b"=")[0]) for word in new ^ self._environment}
        if not self._forked and differing <= _SET_BY_ROSLAUNCH:
            for name in differing:
                os.environ.pop(name, None)
            os.environb.update(word.partition(b"=")[::2] for word in new - self._environment)
            self._environment = new
        return new == self._environment

    def _turn_away(self) -> None:
        """Close the next connection by means of the spare descriptor, since all others are in use."""
        os.close(self._spare)
        with contextlib.suppress(OSError):
            self.listener.accept()[0].close()
        self._spare = os.open(os.devnull, os.O_RDONLY)

    def _fork(self, request: NodeRequest, script: Path, connection: _Peer, watch: int) -> Callable[[], None] | None:
        zygote = os.getpid()
        signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
        gc.freeze()  # so that the garbage collector leaves the pages of these objects shared
        try:
            pid = os.fork()
        except OSError:  # too many processes
            pid = -1
        if pid == 0:
            self._close({watch, connection.detach()})
            _become(request, zygote, self.title, self._interrupt)
            return lambda: _execute(script)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _BLOCKED)
        self._forked = True
        if pid > 0 and self._attend(connection, pid):
            _reply(connection, b"P", pid)
        else:
            connection.close()
        return None

    def _close(self, descriptors: set[int]) -> None:
        """Close these descriptors and those of the zygote, in a forked process."""
        connections = {node.connection.fileno(): node.connection for node in self._nodes.values()}
        for connection in connections.values():
            connection.close()
        for descriptor in {*descriptors, self.listener.detach(), self._spare, *self._nodes} - connections.keys():
            os.close(descriptor)

    def _attend(self, connection: _Peer, pid: int) -> bool:
        """Watch a forked node and its launcher; if that is impossible, kill the node and return False."""
        try:
            watch = os.pidfd_open(pid)
        except OSError:  # too many open descriptors
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return False
        node = _Node(connection, pid, watch)
        for descriptor in (connection.fileno(), watch):
            self._nodes[descriptor] = node
            self._poll.register(descriptor, select.POLLIN)
        return True

    def _prepare(self) -> None:
        """Import the modules that every node needs, including those imported at its start, and find the packages."""
        for name in _COMMON:
            with contextlib.suppress(Exception):  # the nodes report it
                importlib.import_module(name)
        with contextlib.suppress(Exception):
            _share_package_index()

    def _import_ahead(self) -> None:
        for name in self.ahead:
            if self._poll.poll(0):
                return
            with contextlib.suppress(Exception):  # the nodes report it
                importlib.import_module(name)
        if self.ahead and not self._poll.poll(0):
            with contextlib.suppress(Exception):
                _prepare_numba()

    def _import(self, script: Path) -> bool:
        """Import a script's modules; return whether it can run in a fork, which lacks the modules' threads."""
        with contextlib.suppress(OSError, SyntaxError, ValueError, RecursionError):  # the node reports them
            for name in imported_modules(script):
                if name not in self._known:
                    self._known.add(name)
                    with contextlib.suppress(Exception, SystemExit):  # not a module, or the node reports it
                        importlib.import_module(name)
        return threading.active_count() == 1

    def _end(self, node: _Node, descriptor: int) -> None:
        """Report the end of a node, or kill it after the end of its launcher."""
        self._poll.unregister(descriptor)
        del self._nodes[descriptor]
        if descriptor == node.watch:
            os.close(descriptor)
            ended = os.waitid(os.P_PID, node.pid, os.WEXITED | os.WNOWAIT)
            assert ended is not None
            status = ended.si_status << 8 if ended.si_code == os.CLD_EXITED else ended.si_status
            _reply(node.connection, b"E", status)
        elif node.watch in self._nodes:
            _kill(node.pid, signal.SIGKILL)
        if not {node.watch, node.connection.fileno()} & self._nodes.keys():
            os.waitpid(node.pid, 0)  # until then its launcher could signal it by its id
            node.connection.close()

    def _interrupt_nodes(self) -> None:
        for node in set(self._nodes.values()):
            _kill(node.pid, signal.SIGINT)


def _share_package_index() -> None:
    """Search the package path once, since each starting node asks a new ``rospkg.RosPack`` for one package."""
    import rospkg

    paths = rospkg.get_ros_paths()
    index = rospkg.RosPack(paths)
    index.list()

    class RosPack(rospkg.RosPack):  # type: ignore[misc]  # rospkg has no types
        def __init__(self, ros_paths: list[str] | None = None) -> None:
            super().__init__(ros_paths)
            if self._ros_paths == paths:
                self._location_cache = dict(index._location_cache)

    rospkg.RosPack = RosPack


def _prepare_numba() -> None:
    """Load the code that numba would load at the first call of a compiled function."""
    from numba.core.registry import cpu_target

    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


def _reply(connection: _Peer, kind: bytes, value: int) -> None:
    with contextlib.suppress(OSError):  # the launcher has ended
        connection.send(_REPLY.pack(kind, value), socket.MSG_NOSIGNAL)


def _kill(pid: int, number: int) -> None:
    """Send a signal to a node that has not been reaped yet, and to its children."""
    try:
        os.killpg(pid, number)
    except ProcessLookupError:  # it has no group of its own yet
        os.kill(pid, number)


def _become(request: NodeRequest, zygote: int, title: tuple[int, int], interrupt: Any) -> None:
    """Give a forked process the properties that a process started for the node would have."""
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != zygote:  # it has already ended
        os._exit(1)
    os.setsid()
    *standard, folder = request.descriptors
    for number, descriptor in enumerate(standard):
        os.dup2(descriptor, number)
    os.fchdir(folder)
    request.close()
    script = request.command[0]
    _set_title(title, [os.fsencode(sys.executable), *request.command])
    libc.prctl(_PR_SET_NAME, os.path.basename(script)[:15], 0, 0, 0)
    sys.argv = [os.fsdecode(word) for word in request.command]
    sys.orig_argv = [sys.executable, *sys.argv]
    sys.path.insert(0, os.path.dirname(os.path.realpath(sys.argv[0])))
    _open_standard_streams()
    for module, function, arguments in (("rospy.names", "reload_mappings", (sys.argv,)), ("numpy.random", "seed", ())):
        if module in sys.modules:  # modules that have read the command line or were seeded
            getattr(sys.modules[module], function)(*arguments)
    gc.enable()
    signal.signal(signal.SIGINT, interrupt)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _BLOCKED)


def _set_title(title: tuple[int, int], words: list[bytes]) -> None:
    """Write a command line to the memory that /proc shows."""
    address, size = title
    text = b"\0".join(words)[: size - 1]
    ctypes.memmove(address, text.ljust(size, b"\0"), size)


def _open_standard_streams() -> None:
    """Open the standard streams again, as the interpreter does: their buffering depends on the descriptors."""
    buffered = not os.environ.get("PYTHONUNBUFFERED")
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        old = getattr(sys, name)
        binary: Any = open(number, "wb" if number else "rb", -1 if buffered or not number else 0, closefd=False)  # noqa: SIM115
        stream = io.TextIOWrapper(
            binary,
            encoding=old.encoding,
            errors=old.errors,
            newline="\n" if number else None,
            line_buffering=buffered and (number == 2 or binary.isatty()),
            write_through=not buffered,
        )
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)


def _execute(script: Path) -> None:
    """Run a script as the main module."""
    main = types.ModuleType("__main__")
    main.__dict__.update(__file__=str(script), __builtins__=builtins, __cached__=None)
    sys.modules["__main__"] = main
    exec(compile(script.read_bytes(), str(script), "exec"), main.__dict__)


def _title() -> tuple[int, int]:
    """Return address and size of the memory with this process's command line."""
    fields = Path("/proc/self/stat").read_text(encoding="utf-8", errors="replace").rsplit(")", 1)[1].split()
    begin, end = int(fields[45]), int(fields[46])  # fields 48 and 49
    return begin, end - begin


def main() -> None:
    """Serve launchers.

    Arguments: descriptor of the listening socket, process id of roslaunch, comma-separated modules to import ahead.
    """
    listener, roslaunch = (int(word) for word in sys.argv[1:3])
    ahead = [name for name in sys.argv[3].split(",") if name]
    run = Zygote(socket.socket(fileno=listener), roslaunch, ahead, _title()).serve()
    if run is not None:
        run()


if __name__ == "__main__":
    main()
