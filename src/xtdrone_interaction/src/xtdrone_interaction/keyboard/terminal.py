"""The terminal that keys come from and the screen is drawn on: single keys, no echo, and as it was before in the end.

A terminal that can place its cursor (terminfo knows) gets a screen that is redrawn in place; any other, such as
TERM=dumb, gets lines.
"""

from __future__ import annotations

import contextlib
import curses
import errno
import os
import re
import select
import signal
import sys
import termios
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import FrameType

_PADDING = re.compile(rb"\$<[^>]*>")  # terminfo asks slow terminals for pauses
_MOST_UNSENT = 1 << 16  # bytes kept for a terminal that takes none
_SIZE = (80, 24)  # columns, rows of a terminal that does not tell its own
_HANDLED = (
    signal.SIGINT,
    signal.SIGTERM,
    signal.SIGHUP,
    signal.SIGQUIT,
    signal.SIGTSTP,
    signal.SIGCONT,
    signal.SIGWINCH,
)
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class NoTerminalError(Exception):
    """Standard input is no terminal."""


class TerminalGoneError(Exception):
    """The terminal has been closed."""


class Signals:
    """Signals as bytes to be read, so that the main loop takes them where it stands well.

    Attributes:
        descriptor: becomes readable with a signal.
    """

    def __init__(self) -> None:
        """Nothing is changed before the context is entered."""
        self.descriptor, self._write = os.pipe()
        os.set_blocking(self.descriptor, False)
        os.set_blocking(self._write, False)

    def __enter__(self) -> Signals:
        """Take the signals over; SIGHUP stays ignored where it is, as under nohup."""
        numbers = [n for n in _HANDLED if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
        self._before = {number: signal.signal(number, _wake) for number in numbers}
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        return self

    def __exit__(self, *_: object) -> None:
        """Give them back."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self.descriptor)
        os.close(self._write)

    def take(self) -> list[int]:
        """Return the numbers of the signals that have come since the last call."""
        try:
            return list(os.read(self.descriptor, 4096))
        except BlockingIOError:
            return []


def _wake(_number: int, _frame: FrameType | None) -> None:
    """Python has written the signal's number into the pipe."""


@dataclass(frozen=True)
class _Sequences:
    """What a terminal must be told, by terminfo.

    Attributes:
        enter: before the first line.
        leave: after the last.
        clear: clears all.
        end: clears to the line's end.
    """

    enter: bytes
    leave: bytes
    clear: bytes
    end: bytes

    @staticmethod
    def of(descriptor: int) -> _Sequences | None:
        """Return those of the terminal ``TERM``; None if it cannot redraw in place."""
        try:
            curses.setupterm(os.environ.get("TERM", "dumb"), descriptor)
        except curses.error:
            return None
        needed = [curses.tigetstr(name) for name in ("cup", "clear", "el")]
        if not all(needed):
            return None
        smcup, rmcup, civis, cnorm = (curses.tigetstr(name) or b"" for name in ("smcup", "rmcup", "civis", "cnorm"))
        _, clear, end = (_PADDING.sub(b"", text) for text in needed if text)
        return _Sequences(_PADDING.sub(b"", smcup + civis), _PADDING.sub(b"", cnorm + rmcup), clear, end)


def _place(row: int) -> bytes:
    """Return what puts the cursor at the beginning of a row, from 0."""
    return _PADDING.sub(b"", curses.tparm(curses.tigetstr("cup") or b"", row, 0))


class Terminal:
    """Standard input and output as one terminal.

    Attributes:
        input: where keys come from.
        redraws: whether :meth:`draw` can be used; else :meth:`write_line`.
    """

    def __init__(self) -> None:
        """Look what there is; nothing is changed before :meth:`open`.

        Raises:
            NoTerminalError: standard input is no terminal.
        """
        self.input = sys.stdin.fileno()
        if not os.isatty(self.input):
            raise NoTerminalError("standard input is no terminal; start it in one (over ssh: ssh -t HOST ...)")
        self._output = sys.stdout.fileno()
        self._sequences = _Sequences.of(self._output) if os.isatty(self._output) else None
        self.redraws = self._sequences is not None
        self._before: list | None = None  # termios attributes; not None while open
        self._shown: list[str] = []
        self._cleared = False
        self._unsent = b""
        # Of its own, so that a terminal that takes nothing (Ctrl-S, a broken connection) does not hold the steering up.
        # Its flags are not those that the shell shares.
        self._pipe = self._output
        if os.isatty(self._output):
            with contextlib.suppress(OSError):
                self._pipe = os.open(os.ttyname(self._output), os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        try:
            columns, rows = os.get_terminal_size(self._output)
        except OSError:
            return _SIZE
        return columns or _SIZE[0], rows or _SIZE[1]

    @contextlib.contextmanager
    def opened(self) -> Iterator[Terminal]:
        """Single keys, no echo and a screen of its own within the context, whatever ends it."""
        self.open()
        try:
            yield self
        finally:
            self.close()

    def open(self) -> None:
        """Take the terminal; where it is taken already, take it again: somebody else may have changed it.

        In the background this stops the process, as a shell's jobs are.

        Raises:
            InterruptedError: a signal came meanwhile; to be called again if the process is to go on.
            TerminalGoneError: there is none any more.
        """
        before = self._before
        try:
            before = before or termios.tcgetattr(self.input)
            changed = termios.tcgetattr(self.input)
            # Keys come one by one and unseen; Ctrl-S stops nothing; Ctrl-C and Ctrl-Z are signals as ever.
            changed[0] &= ~termios.IXON
            changed[3] &= ~(termios.ICANON | termios.ECHO)
            changed[6][termios.VMIN], changed[6][termios.VTIME] = 1, 0
            termios.tcsetattr(self.input, termios.TCSANOW, changed)
        except termios.error as error:
            if error.args[0] == errno.EINTR:
                raise InterruptedError(*error.args) from error
            raise TerminalGoneError(str(error)) from error
        self._before = before
        if self._sequences is not None:
            self._send(self._sequences.enter)
        self.forget()

    def close(self) -> None:
        """Give the terminal back as it was; keys that nobody has read are dropped."""
        before, self._before = self._before, None
        if before is None:
            return
        if self._sequences is not None:
            self._unsent = b""
            self._send(self._sequences.leave)
        # In the background, where somebody else has the terminal, this would stop the process, and for good.
        ignored = signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        try:
            # A terminal that is gone has nothing to restore. What is still to be written is not waited for.
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self.input, termios.TCSANOW, before)
                termios.tcflush(self.input, termios.TCIFLUSH)
        finally:
            signal.signal(signal.SIGTTOU, ignored)

    def suspend(self) -> None:
        """Stop this process as Ctrl-Z does, with the terminal as it was; return when it is continued.

        The terminal is to be taken again by :meth:`open`, if the process is to go on.
        """
        self.close()
        os.kill(os.getpid(), signal.SIGSTOP)

    def read(self) -> bytes:
        """Return the bytes of keys that have come.

        Raises:
            TerminalGoneError: there will be no more.
        """
        try:
            data = os.read(self.input, 4096)
        except OSError as error:
            raise TerminalGoneError(str(error)) from error
        if not data:
            raise TerminalGoneError("end of input")
        return data

    def forget(self) -> None:
        """Have everything drawn anew next time: the screen has changed under us."""
        self._shown = []
        self._cleared = False

    def draw(self, lines: Sequence[str]) -> None:
        """Show these lines from the top; only those that have changed are sent."""
        if self._sequences is None or not self._flush():
            return
        data = b"" if self._cleared else self._sequences.clear
        old = [*self._shown, *[""] * (len(lines) - len(self._shown))]
        new = [*lines, *[""] * (len(old) - len(lines))]
        for row, (before, now) in enumerate(zip(old, new, strict=True)):
            if before != now:
                data += _place(row) + now.encode(errors="replace") + self._sequences.end
        self._shown, self._cleared = list(lines), True
        self._send(data)

    def write_line(self, text: str) -> None:
        """Write a line that stays, for terminals that cannot redraw."""
        self._send(f"{text}\n".encode())

    def _send(self, data: bytes) -> None:
        if len(self._unsent) < _MOST_UNSENT:
            self._unsent += data
        self._flush()

    def _flush(self) -> bool:
        """Write what the terminal takes now; return whether that is all."""
        try:
            while self._unsent and (self._pipe != self._output or self._writable()):
                self._unsent = self._unsent[os.write(self._pipe, self._unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self._unsent = b""  # nobody is there; the end of input says so
        return not self._unsent

    def _writable(self) -> bool:
        return bool(select.select([], [self._output], [], 0.0)[1])
