"""Decoder from a terminal's bytes to keys.

A key is a character or one of the names below. Escape sequences of other keys (arrows, F5, Alt and a letter, ...) are
dropped as a whole, also when they arrive in pieces, so that their letters and digits are not mistaken for keys.
"""

from __future__ import annotations

PAGE_UP = "Page Up"
PAGE_DOWN = "Page Down"
QUIT = "Ctrl-C"
REDRAW = "Ctrl-L"

_ESCAPE = 0x1B
_CONTROLS = {0x03: QUIT, 0x0C: REDRAW}
_SEQUENCES = {b"5~": PAGE_UP, b"6~": PAGE_DOWN}  # after ESC [
_LONGEST = 32  # bytes of an escape sequence


class KeyDecoder:
    """Decodes bytes to keys across several reads."""

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
        if not complete and len(sequence) < _LONGEST:
            self._partial = sequence
            return ""
        self._partial = None
        return _SEQUENCES.get(sequence[1:], "") if kind == b"[" else ""
