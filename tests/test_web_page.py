"""The station's page in a browser, with one real flight behind all of its panels."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import Graph, Stack, free_port, wait_for_ports

pytest.importorskip("rospy")
pytest.importorskip("playwright")

from std_msgs.msg import String
from web_browser import StationPage, needs_chromium, station_page
from xtdrone_msgs.msg import SimulationStatus

pytestmark = needs_chromium
FLEET = "iris:3"
COUNT = 3


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """Three vehicles that take XTDrone's commands."""
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("web"), FLEET)
    stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "participants:=/mavros,/communication", "world:=outdoor")
    stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")
    stack.wait(lambda: stack.pose(COUNT - 1), "the vehicles have poses", wall=300.0)
    yield stack
    stack.stop()


@pytest.fixture(scope="module")
def station(stack: Stack) -> Iterator[StationPage]:
    with station_page(stack, free_port()) as page:
        yield page


@pytest.fixture(scope="module")
def actions(graph: Graph) -> Any:
    return graph.hear("/xtdrone/operator_actions", String)


def all_ready() -> str:
    return (
        f"Object.keys(station.status.vehicles).length === {COUNT} && Object.values(station.status.vehicles)"
        ".every(v => v.link && v.estimator?.length === 0 && !v.findings.some(f => f.what === 'arming'))"
    )


def test_a_click_lets_all_take_off_and_is_published(station: StationPage, stack: Stack, actions: Any) -> None:
    page = station.page
    station.until(all_ready())
    assert page.inner_text("tr[data-vehicle=iris_2] [data-cell=state]") == "ready"
    page.click("[data-action=all]")
    page.click("[data-action=takeoff]")
    stack.wait(lambda: min(stack.height(i) for i in range(COUNT)) > 2.2, "all climb", sim=60.0)
    station.until("Object.values(station.status.vehicles).every(v => v.armed)")
    (action,) = [json.loads(message.data) for message in actions.messages]
    names = [f"iris_{i}" for i in range(COUNT)]
    assert action["method"] == "vehicles.command"
    assert action["params"] == {"vehicles": names, "action": "takeoff", "height": 3}
    assert station.page.evaluate("station.view.frames") > 0


def test_a_click_into_the_view_selects_and_sends_there(station: StationPage, stack: Stack) -> None:
    page = station.page
    left, top = page.evaluate(
        "(() => { const box = document.querySelector('[data-panel=scene].mount canvas').getBoundingClientRect();"
        " return [box.left, box.top]; })()"
    )
    x, y = page.evaluate("station.view.screenPlace('iris_1')")
    page.mouse.click(left + x, top + y)
    station.until("station.selection.names.join() === 'iris_1'")
    station.picture("vehicles")
    before = stack.pose(1).position
    page.click("[data-action=goto]")
    page.mouse.click(left + x + 60, top + y + 120)
    stack.wait(lambda: abs(stack.pose(1).position.x - before.x) + abs(stack.pose(1).position.y - before.y) > 1.0,
               "iris_1 goes there", sim=60.0)  # fmt: skip
    assert abs(stack.pose(0).position.x) < 1.0


def test_time_is_paused_stepped_and_resumed(station: StationPage, stack: Stack, graph: Graph) -> None:
    status = graph.hear("/simulator/status", SimulationStatus)
    page = station.page
    page.click("[data-time=pause]")
    station.until("document.querySelector('[data-cell=time-state]').textContent === 'paused'")
    stack.wait(lambda: status.last and status.last.paused, "it is paused")
    tick = status.last.tick
    page.click("[data-time=step]")
    stack.wait(lambda: status.last.tick == tick + 1 and not status.last.stepping, "one tick passes")
    page.click("[data-time=pause]")
    station.until("document.querySelector('[data-cell=time-state]').textContent === 'running'")


def test_xtdrone_s_commands_reach_the_vehicles(station: StationPage, stack: Stack, graph: Graph) -> None:
    heard = graph.hear("/xtdrone/iris_1/cmd", String)
    page = station.page
    page.click("#dock-tabs [data-panel=swarm]")
    page.click("text=1 selected")
    page.click("[data-command=HOVER]")
    stack.wait(lambda: heard.last and heard.last.data == "HOVER", "HOVER is sent")
    page.wait_for_selector("[data-pattern=triangle]")
    page.click("[data-pattern=triangle]")
    station.told("no node subscribes to /xtdrone/leader/cmd")
    station.picture("swarm")
    page.click("#dock-tabs [data-panel=vehicles]")


def test_a_drawn_region_is_planned_and_uploaded(station: StationPage) -> None:
    page = station.page
    page.click("#stage-tabs [data-panel=map]")
    box = page.locator("[data-panel=map].mount canvas").bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 300)
    page.mouse.wheel(0, 700)
    page.click("[data-action=all]")
    page.click("[data-map=region]")
    for x, y in ((200, 220), (560, 250), (520, 640), (180, 600), (200, 220)):
        page.mouse.click(box["x"] + x, box["y"] + y)
    page.click("[data-map=plan]")
    page.wait_for_selector("[data-map=upload]:enabled")
    page.click("[data-map=upload]")
    station.told("3 vehicles have stored their plan")
    station.picture("map")
    page.click("#stage-tabs [data-panel=scene]")


def test_the_page_comes_back_after_the_server_died(station: StationPage, stack: Stack) -> None:
    stack.programs["web_station"].kill()
    station.until("!station.connected")
    assert station.page.inner_text("#link") == "reconnecting"
    station.start_station()
    station.until("station.connected && station.fleet.number < 1000 && station.roster.vehicles.length === 3")
    page = station.page
    page.evaluate("station.selection.set(station.roster.vehicles.map(v => v.name))")
    page.click("[data-action=land]")
    for i in range(COUNT):
        stack.wait_landed(i, sim=60.0)
    assert station.errors == []
