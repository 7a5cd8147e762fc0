"""From a terminal's bytes to keys.

A key is its character, or one of the names below. Keys that a terminal tells by an escape sequence (arrows, F5, Alt and
a letter, ...) must not be taken for the letters and digits in it: all but those named here are dropped as a whole, also
when the sequence comes in pieces.
"""

from __future__ import annotations

PAGE_UP = "Page Up"
PAGE_DOWN = "Page Down"
QUIT = "Ctrl-C"
REDRAW = "Ctrl-L"

_ESCAPE = 0x1B
_CONTROLS = {0x03: QUIT, 0x0C: REDRAW}
_SEQUENCES = {b"5~": PAGE_UP, b"6~": PAGE_DOWN}  # what follows ESC [
_LONGEST = 32  # bytes of a sequence; what is longer is none


class Decoder:
    """Turns bytes into keys, over as many reads as it takes."""

    def __init__(self) -> None:
        """Nothing has been begun."""
        self._begun: bytes | None = None  # an escape sequence without its ESC

    def feed(self, data: bytes) -> list[str]:
        """Return the keys that ``data`` completes, in their order."""
        return [key for key in map(self._take, data) if key]

    def rest(self) -> None:
        """Take it that nothing follows what has come: an ESC alone was the key Esc, and the next key stands alone."""
        self._begun = None

    def _take(self, byte: int) -> str:
        """Take a byte; return the key that ends with it, or an empty string."""
        if byte in _CONTROLS:  # wherever it comes: the way out is always open
            self._begun = None
            return _CONTROLS[byte]
        if byte == _ESCAPE:
            self._begun = b""
            return ""
        if self._begun is None:
            return chr(byte) if 0x20 < byte < 0x7F else ""
        return self._continue(self._begun + bytes([byte]))

    def _continue(self, sequence: bytes) -> str:
        """Return the key of a sequence that is complete; remember one that is not."""
        kind, last = sequence[:1], sequence[-1]
        complete = kind not in (b"[", b"O") or (len(sequence) > 1 and 0x40 <= last <= 0x7E)
        if not complete and len(sequence) < _LONGEST:
            self._begun = sequence
            return ""
        self._begun = None
        return _SEQUENCES.get(sequence[1:], "") if kind == b"[" else ""
