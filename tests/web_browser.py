"""A browser without a screen on the station of a running flight, for tests of the page.

``station_page(stack)`` starts the station beside a stack's simulation and opens its page in Debian's chromium. The
page's own object ``station`` (``web_page/station.js``) reports the received messages.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import WALL_LIMIT, Stack, poll

CHROMIUM = shutil.which("chromium") or ""
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="chromium is not installed")
FLAGS = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-gpu-watchdog",  # it ends what draws, for good, where a busy machine leaves it no time
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL on the processor
    "--enable-unsafe-swiftshader",
)
_URL = re.compile(r"station \(operate\): (\S+)")
_MS = 1000.0 * WALL_LIMIT


class StationPage:
    """The station's page in a browser.

    Attributes:
        page: of playwright.
        errors: messages that the page has logged as errors.
    """

    def __init__(self, stack: Stack, page: Any, port: int) -> None:
        self.page = page
        self.errors: list[str] = []
        self._stack = stack
        self._port = port
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda message: self._note(message))

    def _note(self, message: Any) -> None:
        if message.type == "error" and "WebSocket" not in message.text:  # of a server killed by a test
            self.errors.append(message.text)

    def start_station(self) -> None:
        """Start the station's node and wait until it listens."""
        arguments = [f"_port:={self._port}", "__name:=web_station"]
        program = self._stack.run("web_station", "xtdrone_interaction", "web_station.py", *arguments)
        found = poll(lambda: _URL.search(program.output), "the station prints its URL")
        self.url = found[1]

    def open(self) -> None:
        """Open the page and wait until it is connected and lists all vehicles."""
        self.page.goto(self.url)
        self.until(f"station.connected && station.roster.vehicles.length === {len(self._stack.vehicles)}")
        self.until("station.fleet && station.fleet.number > 1")

    def until(self, condition: str) -> None:
        """Wait until a JavaScript expression is true in the page."""
        poll(lambda: self.page.evaluate(f"Boolean({condition})"), condition)

    def toasts(self) -> str:
        """Return the page's present messages."""
        return str(self.page.inner_text("#toasts"))

    def told(self, text: str) -> None:
        """Wait for a message on the page."""
        poll(lambda: text in self.toasts(), f"the page tells {text!r}")

    def picture(self, name: str) -> None:
        """Store a picture in the folder that XTDRONE_SCREENSHOTS names, if it is set."""
        folder = os.environ.get("XTDRONE_SCREENSHOTS", "")
        if folder:
            self.page.screenshot(path=f"{folder}/{name}.png")


@contextlib.contextmanager
def station_page(stack: Stack, port: int, **sizes: int) -> Iterator[StationPage]:
    """Start the station of a stack's simulation and open its page.

    Args:
        stack: with a running simulation.
        port: TCP port of the station.
        sizes: width and height of the window, px.
    """
    with open_page(**sizes) as page:
        opened = StationPage(stack, page, port)
        opened.start_station()
        opened.open()
        yield opened


@contextlib.contextmanager
def open_page(**sizes: int) -> Iterator[Any]:
    """Open an empty page of playwright's, as wide and high (px) as given, in a browser with an empty profile."""
    from playwright.sync_api import sync_playwright

    size = {"width": 1400, "height": 850, **sizes}
    with tempfile.TemporaryDirectory() as profile, sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            profile, executable_path=CHROMIUM, args=list(FLAGS), viewport=size
        )
        context.pages[0].set_default_timeout(_MS)
        yield context.pages[0]
        context.close()
