"""The station's page in a browser, with one real flight behind all of its panels."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path as Folder
from typing import Any

import pytest
from conftest import Graph, Stack, free_port, poll, wait_for_ports

pytest.importorskip("rospy")
pytest.importorskip("playwright")

import numpy as np
import rosgraph
import rospy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from playwright import sync_api
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from web_browser import StationPage, needs_chromium, station_page
from xtdrone_msgs.msg import SimulationStatus

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_coordination.search.coverage_map import CoverageMap
from xtdrone_coordination.search.planning.region import make_region
from xtdrone_coordination.search.search_node import coverage_message
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline
from xtdrone_planning.trajectories.trajectory_messages import path_message

pytestmark = needs_chromium
FLEET = "iris:2,iris_3d_lidar:1"
NAMES = ("iris_0", "iris_1", "iris_3d_lidar_0")
COUNT = len(NAMES)
CLOUD = "/iris_3d_lidar_0/velodyne_points"
PATH = "/iris_1/planner/path"


@pytest.fixture(scope="module")
def starting(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """Three vehicles that take XTDrone's commands, one with a lidar; the simulator starts."""
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("web"), FLEET)
    stack.launch(
        "multi_vehicle.launch",
        f"vehicles:={FLEET}",
        "participants:=/mavros,/communication,/lidars",
        "world:=outdoor",
        "lidars:=true",
        "lidar_rate:=2",
    )
    # otherwise the communication node stays out of the lockstep, and the simulator waits 120 s for it
    poll(lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "roslaunch starts a simulator")
    stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")
    yield stack
    stack.stop()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def station(starting: Stack, recordings: Folder) -> Iterator[StationPage]:
    """The page, whose station and browser start while the simulator does."""
    rospy.set_param("/web_station/recordings", str(recordings))
    with station_page(starting, free_port()) as page:
        yield page


@pytest.fixture(scope="module")
def stack(starting: Stack, station: StationPage) -> Stack:
    starting.wait(lambda: starting.pose(COUNT - 1), "the vehicles have poses", wall=300.0)
    return starting


@pytest.fixture(scope="module")
def planned_path(graph: Graph) -> str:
    """The topic of a latched path of 12 knots."""
    publish_path(graph, PATH, 0.2)
    return PATH


def publish_path(graph: Graph, topic: str, climb: float) -> None:
    """Publish a straight path along x that climbs by ``climb`` m a knot."""
    spline = UniformSpline(0.0, 0.5, np.array([[float(n), 2.0, 3.0 + climb * n] for n in range(12)]))
    graph.say_latched(topic, path_message(spline, rospy.Time.now(), "map"))


def open_layers(station: StationPage) -> None:
    """Open the list of layers in the 3D view, if it is closed."""
    page = station.page
    page.click("#stage-tabs [data-panel=scene]")
    if not page.locator(".layer-rows").count():
        page.click("[data-layers=list]")


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
    assert page.inner_text("tr[data-vehicle=iris_1] [data-cell=state]") == "ready"
    page.click("[data-action=all]")
    page.click("[data-action=takeoff]")
    stack.wait(lambda: min(stack.height(i) for i in range(COUNT)) > 2.2, "all climb", sim=60.0)
    station.until("Object.values(station.status.vehicles).every(v => v.armed)")
    (action,) = [json.loads(message.data) for message in actions.messages]
    assert action["method"] == "vehicles.command"
    assert action["params"] == {"vehicles": list(NAMES), "action": "takeoff", "height": 3}
    assert station.page.evaluate("station.view.frames") > 0


def test_a_click_into_the_view_selects_and_sends_there(station: StationPage, stack: Stack) -> None:
    page = station.page
    left, top = page.evaluate(
        "(() => { const box = document.querySelector('[data-panel=scene].mount canvas').getBoundingClientRect();"
        " return [box.left, box.top]; })()"
    )

    def is_selected() -> bool:
        nonlocal x, y
        x, y = page.evaluate("station.view.screenPlace('iris_1')")  # it is climbing
        page.mouse.click(left + x, top + y)
        return bool(page.evaluate("station.selection.names.join() === 'iris_1'"))

    x = y = 0.0
    poll(is_selected, "iris_1 is selected by a click")
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

    def held() -> bool:
        """Return whether two messages have reported a pause: the first may be of the tick before the last one."""
        last = status.messages[-2:]
        return len(last) == 2 and all(message.paused for message in last) and last[0].tick == last[1].tick

    stack.wait(held, "it is paused at a tick")
    tick = status.last.tick
    page.click("[data-time=step]")
    stack.wait(lambda: status.last.tick == tick + 1 and not status.last.stepping, "one tick passes")
    page.click("[data-time=pause]")
    station.until("document.querySelector('[data-cell=time-state]').textContent === 'running'")


def test_xtdrone_s_commands_reach_the_vehicles(station: StationPage, stack: Stack) -> None:
    page = station.page
    page.click("#dock-tabs [data-panel=swarm]")
    page.click("text=1 selected")
    page.click("[data-command=HOVER]")
    stack.log_has("communication", "iris_1: HOVER")
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


@pytest.mark.usefixtures("planned_path")
def test_a_lidar_s_cloud_and_a_planned_path_are_layers(station: StationPage, stack: Stack) -> None:
    page = station.page
    open_layers(station)
    for topic in (CLOUD, PATH):
        page.check(f"[data-layer='{topic}']")
        station.until(f"station.view.layer('{topic}')?.count > 20")
    cloud, path = (page.evaluate(f"station.view.layer('{topic}')") for topic in (CLOUD, PATH))
    assert (cloud["kind"], path["kind"]) == ("points", "line")
    assert path["origin"] == pytest.approx([1.0, 2.0, 3.2], abs=0.01)  # from the spline's first three points
    assert path["extent"][0] == pytest.approx(9.0, abs=0.1)
    vehicle = stack.pose(2).position  # the lidar sees the ground around it, in the map frame
    middle = [low + 0.5 * extent for low, extent in zip(cloud["origin"], cloud["extent"], strict=True)]
    assert abs(middle[0] - vehicle.x) < 25.0
    assert abs(middle[1] - vehicle.y) < 25.0
    assert abs(cloud["origin"][2]) < 1.0
    station.picture("layers")
    page.uncheck(f"[data-layer='{CLOUD}']")
    station.until(f"station.view.layer('{CLOUD}') === undefined")


@pytest.mark.usefixtures("planned_path")
def test_a_layer_that_cannot_be_shown_says_why_and_the_others_go_on(station: StationPage, graph: Graph) -> None:
    page = station.page
    open_layers(station)
    page.check(f"[data-layer='{PATH}']")
    wrong = PointCloud2(height=1, width=100, point_step=12, data=bytes(12))
    graph.say_latched("/wrong/points", wrong)
    lost = Path(poses=[PoseStamped()])
    lost.header.frame_id = "nowhere"
    graph.say_latched("/wrong/path", lost)
    for topic, text in (
        ("/wrong/points", "12 bytes are too few for 100 points"),
        ("/wrong/path", "frame_id: 'nowhere'"),
    ):
        page.check(f"[data-layer='{topic}']")
        page.wait_for_selector(f"[data-fault='{topic}']:has-text(\"{text}\")")
        page.uncheck(f"[data-layer='{topic}']")
    station.until(f"station.view.layer('{PATH}')?.count > 20")


@pytest.mark.usefixtures("planned_path")
def test_a_stored_layer_comes_on_when_it_is_published(station: StationPage, graph: Graph) -> None:
    page, later = station.page, "/planned_later/path"
    layers = [{"name": later, "type": "nav_msgs/Path"}]
    page.evaluate("layers => localStorage.setItem('xtdrone-layers', JSON.stringify(layers))", layers)
    station.open()
    open_layers(station)
    row = page.locator("label", has=page.locator(f"[data-layer='{later}']"))
    sync_api.expect(row).to_contain_text("not published yet")
    page.check(f"[data-layer='{PATH}']")  # another choice keeps it stored
    publish_path(graph, later, 0.0)
    station.until(f"station.view.layer('{later}')?.count > 20")
    sync_api.expect(row).not_to_contain_text("not published yet")
    assert page.locator(f"[data-layer='{later}']").is_checked()
    assert {"name": later, "type": "nav_msgs/Path"} in page.evaluate("JSON.parse(localStorage['xtdrone-layers'])")


def test_the_map_shows_what_a_search_has_seen(station: StationPage, graph: Graph) -> None:
    page = station.page
    camera = Pinhole(100, 100, 50.0, 50.0, 50.0, 50.0)
    coverage = CoverageMap(make_region([(0, 0), (40, 0), (40, 30), (0, 30)]), camera, pixels=0.0)
    graph.say_latched("/xtdrone/search/coverage", coverage_message(coverage.grid(), 0.0, rospy.Time.now()))
    progress = {"sim_time": 1.0, "phase": "searching", "text": "covered 0 %, 3 of 3 flying", "covered_fraction": 0.0}
    page.click("#stage-tabs [data-panel=map]")
    graph.say("/xtdrone/search/progress", String(json.dumps(progress)))
    station.until("station.map.coverage.unseen === 1200")
    assert page.evaluate("station.map.coverage.seen") == 0
    down = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    coverage.add_picture(np.array([20.0, 15.0, 12.0]), down)
    graph.say_latched("/xtdrone/search/coverage", coverage_message(coverage.grid(), 0.0, rospy.Time.now()))
    seen = round(1200 * coverage.fraction)
    assert seen > 100
    station.until(f"station.map.coverage.seen === {seen}")
    station.picture("coverage")
    page.click("#stage-tabs [data-panel=scene]")


def test_a_gamepad_that_is_unplugged_stops_the_vehicle(station: StationPage, stack: Stack) -> None:
    page = station.page
    page.evaluate("station.selection.set(['iris_0'])")
    page.click("#dock-tabs [data-panel=steering]")
    page.evaluate(
        "() => { const buttons = Array.from({length: 10}, () => ({pressed: false}));"
        " window.pad = {connected: true, id: 'a gamepad', axes: [0, 0, 0, 0], buttons};"
        " navigator.getGamepads = () => [window.pad]; }"
    )
    page.click("[data-role=begin]")
    page.wait_for_selector("[data-role=end]")
    page.keyboard.press("b")
    stack.wait_state(0, mode="OFFBOARD")
    page.evaluate("window.pad.axes[0] = -0.8")
    stack.wait(lambda: turning(stack) > 0.3, "the stick turns it", sim=120.0)
    page.evaluate("window.pad = null")
    station.told("The gamepad has disappeared: the vehicles stop.")
    stack.wait(lambda: turning(stack) < 0.05, "it stops", sim=120.0)


def turning(stack: Stack) -> float:
    """Return the first vehicle's true rate of turn, rad/s."""
    states = stack.states
    return abs(states.twist[states.name.index(NAMES[0])].angular.z)


def test_two_pages_are_told_what_the_other_one_does(station: StationPage) -> None:
    page = station.page
    page.evaluate("import('/station.js').then(module => { window.other = new module.Station(); other.start(); })")
    station.until("window.other?.connected")
    page.evaluate("other.call('vehicles.command', {vehicles: ['iris_1'], action: 'hold'})")
    station.told(": hold: iris_1")
    page.evaluate("other.call('steering.open', {vehicles: ['iris_0']})")
    station.told("another page steers iris_0 now; this page no longer does")
    page.evaluate("other.call('steering.close').then(() => { other.start = () => {}; })")


def test_the_page_comes_back_after_the_server_died(station: StationPage, stack: Stack, recordings: Folder) -> None:
    page = station.page
    page.click("#dock-tabs [data-panel=recordings]")
    page.click("[data-role=record]")
    page.wait_for_selector("[data-role=stop]")
    page.click("#dock-tabs [data-panel=steering]")
    page.click("[data-role=begin]")
    page.wait_for_selector("[data-role=end]")
    for _ in range(30):
        page.keyboard.press("j")
    stack.wait(lambda: turning(stack) > 0.2, "the keys turn it", sim=120.0)
    poll(lambda: list(recordings.glob("*.active")), "the recording has begun")
    stack.programs["web_station"].kill()
    station.until("!station.connected")
    assert page.inner_text("#link") == "reconnecting"
    station.told("The connection is lost, and this page no longer steers.")
    station.start_station()
    station.until("station.connected && station.fleet.number < 1000 && station.roster.vehicles.length === 3")
    station.told("The station was started again; stopped: iris_0.")
    stack.wait(lambda: turning(stack) < 0.05, "it stops", sim=120.0)
    poll(lambda: not list(recordings.glob("*.active")) and list(recordings.glob("*.bag")), "the recording is whole")
    page.click("#dock-tabs [data-panel=vehicles]")
    page.evaluate("station.selection.set(station.roster.vehicles.map(v => v.name))")
    page.click("[data-action=land]")
    for i in range(COUNT):
        stack.wait_landed(i, sim=60.0)
    assert station.errors == []
