"""The live window: a Matplotlib picture on Tk with mouse and keys. It draws the newest state as often as possible."""

from __future__ import annotations

import gc
import os
import re
import socket
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from xtdrone_swarm.view.swarm_picture import Frame, SwarmView

PERIOD = 1.0 / 30.0  # s, minimum wall time between two pictures
ZOOM_STEP = 1.15  # per notch of the wheel
_TURN = 180.0  # deg, for a drag across the window
_DISPLAY = re.compile(r"(?P<host>[^:/]*):(?P<number>\d+)(\.\d+)?")
_X_PORT = 6000  # TCP, of display 0
_PATIENCE = 2.0  # s of wall time
_LEAST_WAIT = 1  # ms between two turns, so that mouse and keys are handled
HINT = "h: help"
HELP = """scroll   zoom
drag     turn
space    pause
r        reset the view
t        trails
e        edges of the topology
s        slots
h        this help
q        close"""


class WindowError(RuntimeError):
    """The window cannot be opened."""


class Window:
    """A window with the picture of a swarm.

    Attributes:
        view: view that draws the pictures.
        open: whether the window is open.
        paused: whether the user has paused the swarm.
        pictures: number of pictures drawn so far.
    """

    def __init__(self, view: SwarmView, title: str = "XTDrone") -> None:
        """Open a window of the view's size.

        Raises:
            WindowError: no display is available, or Tk is missing.
        """
        check_display()
        try:
            import tkinter

            from matplotlib.backends.backend_tkagg import FigureCanvasTkAgg
        except ImportError as error:
            raise WindowError(f"window: Tk is missing (packages python3-tk, python3-pil.imagetk): {error}") from error
        self.view = view
        self.open = True
        self.paused = False
        self.pictures = 0
        self._stale = True
        self._grip: tuple[float, float] | None = None
        self._timer = ""
        self._error: tuple[type[BaseException], BaseException, TracebackType | None] | None = None
        self._trails = view.trails
        self._keys: dict[str, Callable[[], None]] = {
            " ": self._pause,
            "r": view.camera.reset,
            "t": self._toggle_trails,
            "e": self._toggle_edges,
            "s": self._toggle_slots,
            "h": self._help,
            "q": self.close,
            "escape": self.close,
        }
        try:
            self._root = tkinter.Tk(className="XTDrone")
        except tkinter.TclError as error:
            raise WindowError(f"window: the display cannot be opened: {error}; {_ADVICE}") from error
        self._root.title(title)
        self._root.minsize(320, 240)
        self._root.protocol("WM_DELETE_WINDOW", self.close)
        self._root.report_callback_exception = self._note_error  # type: ignore[method-assign, assignment]
        self._canvas = FigureCanvasTkAgg(view.figure, master=self._root)
        self._canvas.get_tk_widget().pack(fill="both", expand=True)
        for name, handler in (
            ("scroll_event", self._on_scroll),
            ("button_press_event", self._on_press),
            ("button_release_event", self._on_release),
            ("motion_notify_event", self._on_motion),
            ("key_press_event", self._on_key),
            ("resize_event", self._on_resize),
        ):
            self._canvas.mpl_connect(name, handler)
        self._said = ""
        self._set_hint()

    # ---- running ----

    def run(self, source: Callable[[], Frame | None]) -> None:
        """Show the frames from ``source`` until the window is closed.

        Args:
            source: called between pictures; returns the newest state, or None if it is unchanged. The window is blocked
                meanwhile, so it should return within a few hundredths of a second.

        Raises:
            BaseException: any exception from ``source``, including KeyboardInterrupt; the window is closed.
        """
        self._timer = self._root.after(0, self._turn, source)
        try:
            self._root.mainloop()
        finally:
            self.open = False
            self._root.after_cancel(self._timer)
            self._free()
        if self._error is not None:
            raise self._error[1].with_traceback(self._error[2])

    def _turn(self, source: Callable[[], Frame | None]) -> None:
        if not self.open:
            return
        began = time.monotonic()
        frame = source()
        if frame is not None:
            self.view.update(frame)
            self._stale = True
        self.redraw()
        wait = max(_LEAST_WAIT, round(1000.0 * (PERIOD - (time.monotonic() - began))))
        self._timer = self._root.after(wait, self._turn, source)

    def redraw(self) -> None:
        """Draw if the view has changed since the last picture."""
        if self._stale and self.open:
            self._stale = False
            self.view.refresh(self._canvas)
            self._canvas.blit()
            self.pictures += 1

    def say(self, text: str) -> None:
        """Show a line of text in the lower right corner; "" for none."""
        if text != self._said:
            self._said = text
            self._set_hint()
            self._stale = True

    def close(self) -> None:
        """Close the window; :meth:`run` returns."""
        if not self.open:
            return
        self.open = False
        if self._timer:
            self._root.quit()
        else:  # run() was never called
            self._free()

    def _free(self) -> None:
        """Release all Tk objects now: garbage collection in another thread could abort the process later."""
        self._root.destroy()
        self.view.figure.set_canvas(self.view.canvas)  # detach the figure from the window
        del self._canvas, self._root
        gc.collect()

    def _note_error(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        """Store an exception from a handler for the caller of :meth:`run`; Tk would only print it."""
        if self._error is None:
            self._error = kind, error, trace
        self.close()

    # ---- mouse and keys ----

    def _on_scroll(self, event: Any) -> None:
        self.view.camera.magnify(ZOOM_STEP**event.step)
        self._stale = True

    def _on_press(self, event: Any) -> None:
        if event.button == 1:
            self._grip = (event.x, event.y)

    def _on_release(self, event: Any) -> None:
        if event.button == 1:
            self._grip = None

    def _on_motion(self, event: Any) -> None:
        if self._grip is None:
            return
        width, height = self.view.size
        across, up = event.x - self._grip[0], event.y - self._grip[1]
        self.view.camera.turn(-_TURN * across / width, -_TURN * up / height)
        self._grip = (event.x, event.y)
        self._stale = True

    def _on_key(self, event: Any) -> None:
        action = self._keys.get(event.key)
        if action is not None:
            action()
            self._stale = True

    def _on_resize(self, _: Any) -> None:
        self._stale = True

    def _pause(self) -> None:
        self.paused = not self.paused
        self._set_hint()

    def _set_hint(self) -> None:
        paused = "paused (space: continue)" if self.paused else ""
        self.view.hint = "   ".join(text for text in (self._said, paused, HINT) if text)

    def _toggle_trails(self) -> None:
        self.view.trails = 0.0 if self.view.trails > 0.0 else self._trails

    def _toggle_edges(self) -> None:
        self.view.show_edges = not self.view.show_edges

    def _toggle_slots(self) -> None:
        self.view.show_slots = not self.view.show_slots

    def _help(self) -> None:
        self.view.help = "" if self.view.help else HELP


_ADVICE = "a film needs none: give a file name that ends with .mp4, .gif or .png (Swarm.film, ~film of visualize.py)"


def can_open() -> bool:
    """Return whether the display in DISPLAY accepts connections.

    Probe the socket rather than open and close a window: an X server resets when its last client disconnects, which
    drops clients that connect at that moment.
    """
    name = _DISPLAY.fullmatch(os.environ.get("DISPLAY", ""))
    if name is None:
        return False
    host, number = name["host"], int(name["number"])
    path = f"/tmp/.X11-unix/X{number}"
    local: list[tuple[int, Any]] = [(socket.AF_UNIX, f"\0{path}"), (socket.AF_UNIX, path)]
    return any(map(_answers, local if host in ("", "unix") else [(socket.AF_INET, (host, _X_PORT + number))]))


def _answers(place: tuple[int, Any]) -> bool:
    family, address = place
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.settimeout(_PATIENCE)
        try:
            probe.connect(address)
        except OSError:
            return False
    return True


def check_display() -> None:
    """Raise WindowError with advice if DISPLAY is not set."""
    if not os.environ.get("DISPLAY"):
        raise WindowError(f"window: there is no display (DISPLAY is not set); {_ADVICE}")
