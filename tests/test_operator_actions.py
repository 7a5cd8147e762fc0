"""A session with clicks is recorded, and its actions, repeated on another simulation, give the same flight."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import START_LIMIT, Graph, Stack, free_port, poll, wait_for_ports

pytest.importorskip("rospy")
pytest.importorskip("playwright")

import rospy
from web_browser import StationPage, needs_chromium, station_page

from validation.replay.digests import Digests, compare, read_digests
from xtdrone_interaction.web.actions.recorded_actions import read_actions

pytestmark = needs_chromium
FLEET = "iris:2"


def fly(graph: Graph, folder: Path, operate: Callable[[Stack], None], *options: str) -> Digests:
    """Fly while ``operate`` acts, and return the digests; ``options`` are of the launch file."""
    folder.mkdir()
    wait_for_ports(FLEET)
    stack = Stack(graph, folder, FLEET)
    file = folder / "digest.jsonl"
    arguments = (f"vehicles:={FLEET}", "participants:=/mavros,/communication", f"digest:={file}", *options)
    try:
        stack.launch("multi_vehicle.launch", *arguments)
        poll(lambda: rospy.has_param("/lockstep/uri"), "the simulator offers its lockstep", START_LIMIT)
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "0-1")
        operate(stack)
    finally:
        stack.stop()
    graph.forget()
    return read_digests(file)


def click_through(page: StationPage, stack: Stack) -> None:
    """Fly by clicks and keys: take off, go to, steer, land."""
    browser = page.page
    page.until("Object.values(station.status.vehicles).filter(v => v.link && v.estimator?.length === 0).length === 2")
    browser.click("[data-action=all]")
    browser.click("[data-action=takeoff]")
    stack.wait(lambda: stack.height(1) > 1.0, "they climb", sim=60.0)
    browser.evaluate(
        "station.call('vehicles.command', {vehicles: ['iris_0', 'iris_1'], action: 'goto', place: [4, 2, 3]})"
    )
    browser.click("#dock-tabs [data-panel=swarm]")
    browser.click("text=2 selected")
    browser.click("[data-command=HOVER]")
    browser.click("#dock-tabs [data-panel=steering]")
    browser.click("[data-role=begin]")
    browser.wait_for_selector("[data-role=end]")
    for key in "iiw":
        browser.keyboard.press(key)
    stack.pass_time(0.5)
    browser.click("#dock-tabs [data-panel=vehicles]")
    browser.click("[data-action=land]")
    stack.pass_time(2.0)


def test_a_recorded_session_is_repeated_to_the_last_bit(graph: Graph, tmp_path: Path) -> None:
    def recorded(stack: Stack) -> None:
        rospy.set_param("/web_station/recordings", str(tmp_path))
        with station_page(stack, free_port()) as page:
            page.page.evaluate("station.call('recordings.start', {profile: 'light'})")
            click_through(page, stack)
            page.page.evaluate("station.call('recordings.stop')")

    def repeated(stack: Stack) -> None:
        arguments = ("-m", "xtdrone_interaction", "replay-actions", str(bag))
        status = stack.start("replay", [sys.executable, *arguments]).end(START_LIMIT)
        assert status == 0, stack.programs["replay"].output
        assert "vehicles.command: done by iris_0, iris_1" in stack.programs["replay"].output
        stack.wait(lambda: stack.time > first.end * 1e-6, "the flight is as long as the first", sim=1000.0)

    first = fly(graph, tmp_path / "recorded", recorded, "speed:=2")
    (bag,) = tmp_path.glob("*.bag")
    actions = read_actions([bag])
    assert {action.method for action in actions} == {"vehicles.command", "swarm.command", "steering.send"}
    assert all(action.exact for action in actions)
    second = fly(graph, tmp_path / "repeated", repeated, "speed:=0", "paused:=true")
    result = compare(first, second, first.end // 1_000_000 * 1_000_000 - 1_000_000)
    assert result.time > actions[-1].time
    assert result.same, result
