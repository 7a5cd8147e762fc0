"""The terminal for keys and screen: unbuffered keys, no echo, restored at the end.

A terminal that can position its cursor (by terminfo) gets a screen that is redrawn in place; others, such as TERM=dumb,
get lines.
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

_PADDING = re.compile(rb"\$<[^>]*>")  # delays for slow terminals in terminfo strings
_MOST_UNSENT = 1 << 16  # bytes buffered for a blocked terminal
_SIZE = (80, 24)  # default columns and rows
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


PAGE_UP = "Page Up"
PAGE_DOWN = "Page Down"
QUIT = "Ctrl-C"
REDRAW = "Ctrl-L"

_ESCAPE = 0x1B
_CONTROLS = {0x03: QUIT, 0x0C: REDRAW}
_SEQUENCES = {b"5~": PAGE_UP, b"6~": PAGE_DOWN}  # after ESC [
_LONGEST_SEQUENCE = 32  # bytes of an escape sequence


class NoTerminalError(Exception):
    """Standard input is not a terminal."""


class TerminalGoneError(Exception):
    """The terminal has been closed."""


class KeyDecoder:
    """Decodes a terminal's bytes to keys, across several reads.

    A key is a character or ``PAGE_UP``, ``PAGE_DOWN``, ``QUIT``, ``REDRAW``. Escape sequences of other keys (arrows,
    F5, Alt and a letter, ...) are dropped as a whole, also when they arrive in pieces, so that their letters and digits
    are not mistaken for keys.
    """

    def __init__(self) -> None:
        """Start without a partial sequence."""
        self._partial: bytes | None = None  # escape sequence so far, without its ESC

    def feed(self, data: bytes) -> list[str]:
        """Return the keys that ``data`` completes, in order."""
        return [key for key in map(self._feed_byte, data) if key]

    def drop_partial(self) -> None:
        """Drop a partial sequence after a pause: it was the key Esc alone."""
        self._partial = None

    def _feed_byte(self, byte: int) -> str:
        """Process a byte and return the key that it completes, or an empty string."""
        if byte in _CONTROLS:  # even within a sequence, so that Ctrl-C always works
            self._partial = None
            return _CONTROLS[byte]
        if byte == _ESCAPE:
            self._partial = b""
            return ""
        if self._partial is None:
            return chr(byte) if 0x20 < byte < 0x7F else ""
        return self._continue(self._partial + bytes([byte]))

    def _continue(self, sequence: bytes) -> str:
        """Return the key of a complete sequence; store an incomplete one."""
        kind, last = sequence[:1], sequence[-1]
        complete = kind not in (b"[", b"O") or (len(sequence) > 1 and 0x40 <= last <= 0x7E)
        if not complete and len(sequence) < _LONGEST_SEQUENCE:
            self._partial = sequence
            return ""
        self._partial = None
        return _SEQUENCES.get(sequence[1:], "") if kind == b"[" else ""


class Signals:
    """Signals as bytes in a pipe, so that the main loop handles them at a safe point.

    Attributes:
        descriptor: becomes readable on a signal.
    """

    def __init__(self) -> None:
        """Create the pipe; handlers are installed by the context."""
        self.descriptor, self._write = os.pipe()
        os.set_blocking(self.descriptor, False)
        os.set_blocking(self._write, False)

    def __enter__(self) -> Signals:
        """Install the handlers; SIGHUP stays ignored if it is, as under nohup."""
        numbers = [n for n in _HANDLED if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
        self._before = {number: signal.signal(number, _wake) for number in numbers}
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the handlers."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self.descriptor)
        os.close(self._write)

    def take(self) -> list[int]:
        """Return the numbers of the signals since the last call."""
        try:
            return list(os.read(self.descriptor, 4096))
        except BlockingIOError:
            return []


def _wake(_number: int, _frame: FrameType | None) -> None:
    """Do nothing: Python has written the signal's number into the pipe."""


@dataclass(frozen=True)
class _Sequences:
    """Control sequences of a terminal, from terminfo.

    Attributes:
        enter: sent before the first line.
        leave: sent after the last line.
        clear: clears the screen.
        end: clears the rest of a line.
    """

    enter: bytes
    leave: bytes
    clear: bytes
    end: bytes

    @staticmethod
    def of(descriptor: int) -> _Sequences | None:
        """Return the sequences of the terminal ``TERM``; None if it cannot redraw in place."""
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
    """Return the sequence that moves the cursor to the start of a row, from 0."""
    return _PADDING.sub(b"", curses.tparm(curses.tigetstr("cup") or b"", row, 0))


class Terminal:
    """Standard input and output as one terminal.

    Attributes:
        input: descriptor of the keys.
        redraws: whether :meth:`draw` is supported, otherwise :meth:`write_line`.
    """

    def __init__(self) -> None:
        """Inspect the terminal; :meth:`open` changes it.

        Raises:
            NoTerminalError: standard input is not a terminal.
        """
        self.input = sys.stdin.fileno()
        if not os.isatty(self.input):
            raise NoTerminalError("standard input is not a terminal; start it in one (over ssh: ssh -t HOST ...)")
        self._output = sys.stdout.fileno()
        self._sequences = _Sequences.of(self._output) if os.isatty(self._output) else None
        self.redraws = self._sequences is not None
        self._before: list | None = None  # termios attributes; not None while open
        self._shown: list[str] = []
        self._cleared = False
        self._unsent = b""
        # Open it again without blocking, so that a blocked terminal (Ctrl-S, a broken connection) does not delay
        # commands. The flags of standard output are shared with the shell and stay unchanged.
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
        """Open the terminal within the context."""
        self.open()
        try:
            yield self
        finally:
            self.close()

    def open(self) -> None:
        """Set unbuffered keys without echo; repeat it on an open terminal to undo changes by other programs.

        In the background this stops the process, like other jobs of a shell.

        Raises:
            InterruptedError: a signal has arrived; call again to continue.
            TerminalGoneError: the terminal has been closed.
        """
        before = self._before
        try:
            before = before or termios.tcgetattr(self.input)
            changed = termios.tcgetattr(self.input)
            # No line buffer, no echo, no flow control by Ctrl-S; Ctrl-C and Ctrl-Z remain signals.
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
        """Restore the terminal and drop unread keys."""
        before, self._before = self._before, None
        if before is None:
            return
        if self._sequences is not None:
            self._unsent = b""
            self._send(self._sequences.leave)
        # In the background, SIGTTOU would stop the process for good.
        ignored = signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        try:
            # A closed terminal needs no restoring. Do not wait for unwritten output.
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self.input, termios.TCSANOW, before)
                termios.tcflush(self.input, termios.TCIFLUSH)
        finally:
            signal.signal(signal.SIGTTOU, ignored)

    def suspend(self) -> None:
        """Restore the terminal and stop this process, as Ctrl-Z does; return when it is continued.

        Call :meth:`open` afterwards.
        """
        self.close()
        os.kill(os.getpid(), signal.SIGSTOP)

    def read(self) -> bytes:
        """Return the bytes of pressed keys.

        Raises:
            TerminalGoneError: the terminal has been closed.
        """
        try:
            data = os.read(self.input, 4096)
        except OSError as error:
            raise TerminalGoneError(str(error)) from error
        if not data:
            raise TerminalGoneError("end of input")
        return data

    def forget(self) -> None:
        """Redraw everything next time, because the screen has changed."""
        self._shown = []
        self._cleared = False

    def draw(self, lines: Sequence[str]) -> None:
        """Draw lines from the top, sending only those that have changed."""
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
        """Write a line, for terminals that cannot redraw."""
        self._send(f"{text}\n".encode())

    def _send(self, data: bytes) -> None:
        if len(self._unsent) < _MOST_UNSENT:
            self._unsent += data
        self._flush()

    def _flush(self) -> bool:
        """Write as much as the terminal accepts and return whether that was all."""
        try:
            while self._unsent and (self._pipe != self._output or self._writable()):
                self._unsent = self._unsent[os.write(self._pipe, self._unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self._unsent = b""  # the terminal is closed; reading reports it
        return not self._unsent

    def _writable(self) -> bool:
        return bool(select.select([], [self._output], [], 0.0)[1])
