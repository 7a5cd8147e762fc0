"""A tree of processes that is gone when it is told to, whatever becomes of any of its members. Linux only.

roslaunch gives every node a session of its own, so neither a process group nor a session holds them all. Here each tree
has a *guard* for its root: this very file, run as a program by a bare interpreter. The guard is the *subreaper* of what
it starts: a process that loses its parent becomes the guard's child, so that all of the tree can be found and ended. It
does so when its program has ended, and when the process that asked for the tree is gone by whatever cause, kill -9
included. That process is a subreaper itself, in case the guard is killed.
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
_STEPS: _Steps = ((signal.SIGINT, 5.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 5.0))  # for what is left, s after each
_ORPHANED = 12.0  # s that the program gets to end by itself when the process that asked for it is gone
_TERMINATED = 3.0  # s that it gets after SIGTERM
_SIGNALLED = 128  # a guard ends with 128 + n when signal n has ended its program
_LOOK = 1.0  # s between two looks at whether that process is there
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)

_libc = ctypes.CDLL(None, use_errno=True)


def _prctl(option: int, value: int) -> None:
    if _libc.prctl(option, value, 0, 0, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"prctl({option}): {os.strerror(number)}")


class ProcessTree:
    """A program and everything that it starts.

    Attributes:
        process: the program's guard, which hands signals on to it and ends with its status (128 + n for signal n).
        pid: the program's own process id; 0 if it could not be started.
    """

    def __init__(self, command: Sequence[str], env: Mapping[str, str], log: Path) -> None:
        """Start ``command`` in a session of its own; its output goes to ``log``. Call it from the main thread.

        Raises:
            OSError: it cannot be started.
        """
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        steps = ",".join(f"{int(number)}:{limit:g}" for number, limit in _STEPS)
        # no site packages and none of the user's variables: it must be small, and start where little else does
        told, tells = os.pipe()
        guard = [sys.executable, "-I", "-S", __file__, str(os.getpid()), steps, str(tells)]
        try:
            with log.open("wb") as output:
                self.process = subprocess.Popen(
                    [*guard, *command],
                    env=dict(env),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    pass_fds=(tells,),
                )
            os.close(tells)
            tells = -1
            self.pid = int(os.read(told, 32) or 0)
        finally:
            for descriptor in (told, tells):
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
        """End the program by SIGKILL, and what is left of its tree."""
        if self.pid and self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        self.stop(_TERMINATED)

    def stop(self, patience: float) -> None:
        """End the program (SIGINT, after ``patience`` s SIGTERM, then SIGKILL), and whatever is left of its tree."""
        rest = _TERMINATED + sum(limit for _, limit in _STEPS)
        for number, limit in ((signal.SIGINT, patience), (signal.SIGTERM, rest + _LOOK), (signal.SIGKILL, _LOOK)):
            if self.process.poll() is not None:
                break
            self.process.send_signal(number)
            self.wait(limit)
        if self.process.returncode == -signal.SIGKILL:  # the guard was killed: its tree is ours to end
            end_descendants()


def descendants() -> list[int]:
    """Return the ids of all living processes below this one, zombies left out."""
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
    """End every process below this one.

    Args:
        steps: signals, with the s to wait after each; None: SIGINT first, SIGKILL in the end.
    """
    for number, limit in _STEPS if steps is None else steps:
        for pid in descendants():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        end = time.monotonic() + limit
        while descendants() and time.monotonic() < end:
            _reap()
            time.sleep(_POLL)  # the kernel tells of our children only, not of theirs
        if not descendants():
            break
    _reap()


def _reap() -> None:
    """Collect the exit status of adopted children."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def die_with_parent(parent: int, number: int = signal.SIGKILL) -> None:
    """Have the kernel send this process ``number`` when its parent, the process ``parent``, ends."""
    _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:  # it died before the kernel knew
        os.kill(os.getpid(), number)


class _Guard:
    """The root of a tree: starts the program and leaves nothing of it."""

    def __init__(self, parent: int, steps: _Steps) -> None:
        self._parent = parent
        self._steps = steps
        # Blocked and fetched one by one, so that none comes between two steps; SIGCHLD wakes.
        self._signals = {*_HEARD, signal.SIGCHLD}
        signal.pthread_sigmask(signal.SIG_BLOCK, self._signals)
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        die_with_parent(parent, signal.SIGTERM)

    def run(self, command: Sequence[str], tells: int) -> int:
        """Run the program; return its status when nothing of its tree is left.

        Args:
            command: the program with its arguments.
            tells: descriptor to which the program's process id is written; closed then.
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
        os.write(tells, str(program.pid).encode())
        os.close(tells)
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
        """Collect the exit status of adopted children, and leave the program's own alone."""
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
