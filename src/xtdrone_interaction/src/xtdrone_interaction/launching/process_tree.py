"""A tree of processes that can be ended completely, even after some of its members have died. Linux only.

roslaunch starts every node in a new session, so neither a process group nor a session contains them all. The root of
each tree is a *guard*: this file, run as a program by a bare interpreter. The guard is the *subreaper* of its
descendants: a process that loses its parent becomes a child of the guard, so that the whole tree can be found and
ended. The guard ends the tree when its program has ended, and when the process that created the tree has ended for any
reason, including kill -9. That process is a subreaper, too, in case the guard is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_POLL = 0.05  # s
_Steps = Sequence[tuple[int, float]]
_STEPS: _Steps = (
    (signal.SIGINT, 5.0),
    (signal.SIGTERM, 3.0),
    (signal.SIGKILL, 5.0),
)  # for the remaining processes, s after each
_ORPHANED = 12.0  # s for the program to end after SIGINT when the process that created the tree has ended
_TERMINATED = 3.0  # s for it to end after SIGTERM
_SIGNALLED = 128  # a guard ends with 128 + n when signal n has ended its program
_LOOK = 1.0  # s between two checks of the creating process
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)

_libc = ctypes.CDLL(None, use_errno=True)


def _prctl(option: int, value: int) -> None:
    if _libc.prctl(option, value, 0, 0, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"prctl({option}): {os.strerror(number)}")


_IMPORTED_AHEAD = (
    "xtdrone_sim.runtime.full_simulation",
    "xtdrone_mavros.mavros_node",
    "xtdrone_control.communication.multirotor",
    "xtdrone_coordination.follower",
)
"""Imported in this order as long as no node waits; those that the simulation waits for come first."""


def roslaunch_words(program: str) -> list[str]:
    """Return the first words of a command line of roslaunch, which starts the zygote of its nodes, too.

    The zygote imports the nodes' modules while roslaunch reads its files.

    Args:
        program: path of roslaunch. Without the launcher of a built workspace it is started directly.
    """
    launcher = os.environ.get("XTDRONE_NODE_LAUNCHER", "")
    if not os.access(launcher, os.X_OK):
        return [program]
    return [launcher, "--ahead", ",".join(_IMPORTED_AHEAD), program]


class ProcessTree:
    """A program and all of its descendants.

    Attributes:
        process: the program's guard, which forwards signals to it and ends with its status (128 + n for signal n).
        pid: process id of the program; 0 if it could not be started.
    """

    def __init__(self, command: Sequence[str], env: Mapping[str, str], log: Path) -> None:
        """Start ``command`` in a new session, its output redirected to ``log``. Call it from the main thread.

        Raises:
            OSError: the process cannot be started.
        """
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        steps = ",".join(f"{int(number)}:{limit:g}" for number, limit in _STEPS)
        # no site packages and no user variables: the guard must be small, and start even in a broken environment
        told, pid_pipe = os.pipe()
        guard = [sys.executable, "-I", "-S", __file__, str(os.getpid()), steps, str(pid_pipe)]
        try:
            with log.open("wb") as output:
                self.process = subprocess.Popen(
                    [*guard, *command],
                    env=dict(env),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    pass_fds=(pid_pipe,),
                )
            os.close(pid_pipe)
            pid_pipe = -1
            self.pid = int(os.read(told, 32) or 0)
        finally:
            for descriptor in (told, pid_pipe):
                if descriptor >= 0:
                    os.close(descriptor)

    def wait(self, timeout: float) -> bool:
        """Wait up to ``timeout`` s and return whether the program has ended."""
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    @property
    def status(self) -> int | None:
        """The program's exit status, -n if signal n ended it; None while it runs."""
        code = self.process.poll()
        return code if code is None or code <= _SIGNALLED else _SIGNALLED - code

    def kill(self) -> None:
        """End the program by SIGKILL, and the rest of its tree."""
        if self.pid and self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        self.stop(_TERMINATED)

    def stop(self, patience: float) -> None:
        """End the program (SIGINT, after ``patience`` s SIGTERM, then SIGKILL), and the rest of its tree."""
        rest = _TERMINATED + sum(limit for _, limit in _STEPS)
        for number, limit in ((signal.SIGINT, patience), (signal.SIGTERM, rest + _LOOK), (signal.SIGKILL, _LOOK)):
            if self.process.poll() is not None:
                break
            self.process.send_signal(number)
            self.wait(limit)
        if self.process.returncode == -signal.SIGKILL:  # the guard was killed: this process must end the tree
            end_descendants()


def descendants() -> list[int]:
    """Return the ids of all descendants of this process, except zombies."""
    children: dict[int, list[int]] = {}
    zombies = set()
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        with contextlib.suppress(OSError):  # it ended meanwhile
            stat = Path(f"/proc/{entry}/stat").read_text(encoding="utf-8", errors="replace")
            state, parent = stat.rsplit(")", 1)[1].split()[:2]
            children.setdefault(int(parent), []).append(int(entry))
            if state in "ZX":
                zombies.add(int(entry))
    found: list[int] = []
    queue = [os.getpid()]
    while queue:
        below = children.get(queue.pop(), [])
        found += below
        queue += below
    return [pid for pid in found if pid not in zombies]


def end_descendants(steps: _Steps | None = None) -> None:
    """End all descendants of this process.

    Args:
        steps: signals and the time to wait after each, s; None for SIGINT, SIGTERM, SIGKILL.
    """
    for number, limit in _STEPS if steps is None else steps:
        for pid in descendants():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        end = time.monotonic() + limit
        while descendants() and time.monotonic() < end:
            _reap()
            time.sleep(_POLL)  # the kernel reports the end of children only
        if not descendants():
            break
    _reap()


def _reap() -> None:
    """Collect the exit status of adopted children."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def die_with_parent(parent: int, number: int = signal.SIGKILL) -> None:
    """Request signal ``number`` from the kernel for the end of this process's parent, the process ``parent``."""
    _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:  # it ended before the request
        os.kill(os.getpid(), number)


class _Guard:
    """The root of a tree: runs the program, then ends all of its descendants."""

    def __init__(self, parent: int, steps: _Steps) -> None:
        self._parent = parent
        self._steps = steps
        # Signals are blocked and fetched one by one, so that none interrupts a step; SIGCHLD wakes the guard.
        self._signals = {*_HEARD, signal.SIGCHLD}
        signal.pthread_sigmask(signal.SIG_BLOCK, self._signals)
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        die_with_parent(parent, signal.SIGTERM)

    def run(self, command: Sequence[str], pid_pipe: int) -> int:
        """Run the program; return its status after its whole tree has ended.

        Args:
            command: the program with its arguments.
            pid_pipe: descriptor to which the program's process id is written; closed afterwards.
        """
        guard = os.getpid()

        def in_child() -> None:
            die_with_parent(guard, signal.SIGTERM)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, self._signals)

        try:
            program = subprocess.Popen(command, preexec_fn=in_child)
        except (OSError, subprocess.SubprocessError) as error:
            print(f"{command[0]}: cannot be started: {error}", file=sys.stderr)
            return 127
        os.write(pid_pipe, str(program.pid).encode())
        os.close(pid_pipe)
        while program.poll() is None:
            heard = signal.sigtimedwait(self._signals, _LOOK)
            number = 0 if heard is None else heard.si_signo
            if os.getppid() != self._parent:
                self._end(program, signal.SIGINT, _ORPHANED)
                break
            if number == signal.SIGTERM:
                self._end(program, number, _TERMINATED)
                break
            if number in _HEARD:
                program.send_signal(number)
            self._collect(program.pid)
        status = program.poll()
        end_descendants(self._steps)
        status = -signal.SIGKILL if status is None else status
        return status if status >= 0 else _SIGNALLED - status

    @staticmethod
    def _end(program: subprocess.Popen[bytes], number: int, limit: float) -> None:
        program.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            program.wait(limit)

    @staticmethod
    def _collect(program: int) -> None:
        """Collect the exit status of adopted children, but not that of the program."""
        while True:
            try:
                ended = os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            except ChildProcessError:
                return
            if ended is None or ended.si_pid == program:
                return
            os.waitpid(ended.si_pid, 0)


if __name__ == "__main__":
    _parent, _steps, _tells, *_command = sys.argv[1:]
    _pairs = [step.split(":") for step in _steps.split(",")]
    sys.exit(_Guard(int(_parent), [(int(number), float(limit)) for number, limit in _pairs]).run(_command, int(_tells)))
