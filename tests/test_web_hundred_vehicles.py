"""A hundred vehicles in the page: few draw calls, coarse meshes where they are far, and no frame without a change."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from conftest import REPOSITORY, poll

pytest.importorskip("rospy")
pytest.importorskip("playwright")

from web_browser import needs_chromium, open_page
from web_fleet_standin import FleetStandIn, fleet_standin

from xtdrone_interaction.web.server import station_server

pytestmark = needs_chromium
COUNT = 100
WORLD = REPOSITORY / "src" / "xtdrone_sim" / "worlds" / "outdoor.world"
MOST_CALLS = 40  # with the 28 textures of the world outdoor
MOST_CALLS_OF_VEHICLES = 12  # with trails, slots, topology and ground
MOST_TRIANGLES = 80_000


@pytest.fixture(scope="module")
def standin() -> Iterator[FleetStandIn]:
    with fleet_standin(f"iris:{COUNT}", str(WORLD)) as standin:
        yield standin


@pytest.fixture(scope="module")
def page(standin: FleetStandIn) -> Iterator[Any]:
    with open_page(width=700, height=500) as page:
        page.goto(standin.url)
        yield page


def until(page: Any, condition: str) -> None:
    poll(lambda: page.evaluate(f"Boolean({condition})"), condition)


def test_all_are_drawn_with_few_calls(page: Any) -> None:
    until(page, "globalThis.station?.view?.costs.first > 0")
    until(page, "station.view.costs.triangles > 20000")  # including the surroundings
    page.evaluate("station.view.costs.restart()")
    until(page, "station.view.costs.summary().frames > 10")
    costs = page.evaluate("station.view.costs.summary()")
    print(f"\n{costs}, first picture after {page.evaluate('station.view.costs.first'):.0f} ms")
    assert costs["calls"] <= MOST_CALLS
    assert costs["triangles"] <= MOST_TRIANGLES
    page.click("text=World")
    until(page, f"station.view.costs.calls <= {MOST_CALLS_OF_VEHICLES}")
    page.click("text=World")
    assert page.evaluate(f"station.view.screenPlace('iris_{COUNT - 1}')") is not None


def test_a_page_whose_hello_was_late_connects_again(page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(station_server, "_HELLO_LIMIT", 0.0)
    page.evaluate(
        "import('/station.js').then(({ Station }) => { window.codes = []; window.late = new Station();"
        " window.WebSocket = class extends WebSocket { constructor(url) {"
        " super(url); this.addEventListener('close', ({ code }) => codes.push(code)); } };"
        " late.start(); })"
    )
    until(page, "window.codes?.length > 1")
    assert not page.evaluate("late.connected")
    monkeypatch.undo()
    until(page, "late.connected")
    assert set(page.evaluate("codes")) == {station_server.NO_HELLO}
    page.evaluate("late.start = () => {}")


def test_nothing_is_drawn_while_nothing_changes(page: Any, standin: FleetStandIn) -> None:
    standin.still = True
    page.wait_for_function("(() => { const n = station.view.frames; return new Promise(done =>"
                           " setTimeout(() => done(station.view.frames === n), 1500)); })()")  # fmt: skip
    frames = page.evaluate("station.view.frames")
    page.evaluate("station.selection.set(['iris_3'])")
    until(page, f"station.view.frames > {frames}")
    standin.still = False
    until(page, f"station.view.frames > {frames + 3}")
