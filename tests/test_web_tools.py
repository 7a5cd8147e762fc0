"""The station's panels in a browser, on a real flight: topics, plots, console, parameters, nodes, images, keyboard,
recordings."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import START_LIMIT, WALL_LIMIT, Graph, Stack, free_port, poll, wait_for_ports

pytest.importorskip("playwright")
pytest.importorskip("rospy")

import rospy
from darknet_ros_msgs.msg import BoundingBox, BoundingBoxes
from mavros_msgs.srv import ParamGet
from playwright import sync_api
from web_browser import needs_chromium, station_page
from xtdrone_msgs.msg import SimulationStatus

VEHICLE = "typhoon_h480_0"
POSE = f"/{VEHICLE}/mavros/local_position/pose"
CAMERA = f"/{VEHICLE}/cgo3_camera/image_raw"
_MS = 1000.0 * WALL_LIMIT
TOO_WIDE = """m => m.scrollWidth <= m.clientWidth ? [] :
  [...m.querySelectorAll('*')].filter(e => e.getBoundingClientRect().right > m.clientWidth)
  .map(e => e.outerHTML.slice(0, 150))"""
"""What makes a panel scroll sideways."""

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory, recordings: Path) -> Iterator[Stack]:
    wait_for_ports("typhoon_h480:1")
    stack = Stack(graph, tmp_path_factory.mktemp("stack"), "typhoon_h480:1")
    arguments = ("vehicles:=typhoon_h480:1", "cameras:=true", "camera_rate:=4", "speed:=2")
    stack.launch("multi_vehicle.launch", *arguments)
    stack.wait(lambda: stack.state(0) is not None, "the vehicle is there", wall=START_LIMIT)
    stack.run("typhoon_communication", "xtdrone_control", "multirotor_communication.py", "typhoon_h480", "0")
    rospy.set_param("/web_station/recordings", str(recordings))
    yield stack
    stack.stop()


@pytest.fixture(scope="module")
def page(stack: Stack) -> Iterator[Any]:
    with station_page(stack, free_port(), width=1000, height=700) as opened:
        yield opened.page
        assert not opened.errors


@pytest.fixture
def panel(page: Any) -> Callable[[str], Any]:
    def show(name: str) -> Any:
        page.click(f"#dock-tabs button[data-panel={name}]")
        return page.locator(f".mount[data-panel={name}]")

    return show


def test_topics_are_listed_measured_and_echoed(page: Any, panel: Callable[[str], Any]) -> None:
    topics = panel("topics")
    topics.locator("input[type=search]").fill("local_position pose")
    row = topics.locator(f'tr[data-topic="{POSE}"]')
    row.locator("td.link").click()
    row.locator("input").check()
    sync_api.expect(topics.locator("[data-role=echo]")).to_contain_text("position:\n    x: ")
    sync_api.expect(row.locator("td").nth(2)).to_contain_text(".", timeout=_MS)
    assert float(row.locator("td").nth(2).inner_text()) > 5.0


def test_plots_draw_a_field_and_export_it(page: Any, panel: Callable[[str], Any]) -> None:
    plots = panel("plots")
    choose_curve(plots)
    poll(lambda: len(plotted(page)[1]) > 10, "ten samples are drawn", WALL_LIMIT)
    head, times = plotted(page)
    assert head == f"time_s,{POSE}/pose.position.z"
    assert len(times) > 10
    assert times == sorted(times)
    assert plots.locator(".uplot canvas").count() == 1


def choose_curve(plots: Any) -> None:
    """Draw the height of the vehicle, unless it is drawn already."""
    curve = plots.locator(f'[data-curve="{POSE}/pose.position.z"]')
    if not curve.count():
        plots.locator("input[type=search]").fill(POSE)
        plots.locator("div.link").first.click()
        plots.locator("button", has_text="pose.position.z").click()
    sync_api.expect(curve).to_be_visible()


def plotted(page: Any) -> tuple[str, list[float]]:
    """Return the first line and the times (s) of the file that the plots export."""
    with page.expect_download() as download:
        page.locator(".mount[data-panel=plots] button", has_text="CSV").click()
    head, *lines = Path(download.value.path()).read_text().splitlines()
    return head, [float(line.split(",")[0]) for line in lines]


def test_the_console_shows_warnings_of_nodes(page: Any, panel: Callable[[str], Any]) -> None:
    console = panel("console")
    rospy.logwarn("the test's warning")
    sync_api.expect(console.locator("tr[data-level=warn]", has_text="the test's warning")).to_be_visible()
    console.locator("select").first.select_option("error")
    sync_api.expect(console.locator("tr[data-level=warn]")).to_have_count(0)


def test_a_parameter_is_set_in_the_vehicle_and_a_wrong_value_refused(
    page: Any, panel: Callable[[str], Any], graph: Graph
) -> None:
    parameters = panel("parameters")
    parameters.locator("[data-role=pull]").click()
    sync_api.expect(parameters.get_by_text("856 read")).to_be_visible(timeout=2 * _MS)
    parameters.locator("input[type=search]").fill("MPC_XY_VEL_MAX")
    row = parameters.locator("tr[data-parameter=MPC_XY_VEL_MAX]")
    for value in ("7.5", "700"):
        row.locator(".link").click()
        row.locator("[data-role=value]").fill(value)
        row.locator("[data-role=set]").click()
        if value == "7.5":
            sync_api.expect(row.locator(".link")).to_have_text("7.5")
    sync_api.expect(page.locator(".toast.bad")).to_contain_text("700 is not allowed, a number from 0 to 20 m/s")
    page.locator(".toast.bad").click()
    assert graph.call(f"/{VEHICLE}/mavros/param/get", ParamGet, param_id="MPC_XY_VEL_MAX").value.real == 7.5
    parameters.locator("[data-role=ros]").click()
    parameters.locator("input[type=search]").fill("simulator/speed")
    sync_api.expect(parameters.locator('tr[data-parameter="/simulator/speed"]')).to_contain_text("real-time factor")


def test_the_graph_shows_who_takes_part_in_the_lockstep(page: Any, panel: Callable[[str], Any]) -> None:
    nodes = panel("nodes")
    sync_api.expect(nodes.locator("g.node.participant[data-node='/mavros']")).to_be_visible()
    sync_api.expect(nodes.locator("g.node.participant[data-node='/simulator']")).to_have_count(0)


def test_images_come_with_the_boxes_of_a_detector(page: Any, panel: Callable[[str], Any], graph: Graph) -> None:
    topic = f"/{VEHICLE}/tried/bounding_boxes"
    publisher = rospy.Publisher(topic, BoundingBoxes, queue_size=1, latch=True)
    box = BoundingBox(Class="person", probability=0.9, xmin=100, xmax=200, ymin=100, ymax=300)
    publisher.publish(BoundingBoxes(bounding_boxes=[box]))
    images = panel("images")
    images.locator("[data-role=image]").select_option(CAMERA)
    card = images.locator(f'[data-image="{CAMERA}"]')
    sync_api.expect(card).to_contain_text("640×360 px", timeout=_MS)
    sync_api.expect(card).to_contain_text("1 detections", timeout=_MS)
    colours = card.locator("canvas").evaluate(
        "c => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; const n = new Set();"
        " for (let i = 0; i < d.length; i += 4000) n.add(d[i] + ',' + d[i + 1] + ',' + d[i + 2]); return n.size; }"
    )
    assert colours > 1
    publisher.unregister()


def test_keys_fly_the_vehicle_and_the_flight_is_recorded_and_played(
    page: Any, panel: Callable[[str], Any], stack: Stack, recordings: Path
) -> None:
    panel("recordings").locator("[data-role=record]").click()
    page.wait_for_selector("[data-role=stop]")
    steering = panel("steering")
    steering.locator("[data-role=begin]").click()
    page.wait_for_selector("[data-role=end]")
    sync_api.expect(steering.locator("[data-role=deaf]")).to_contain_text("until OFFBOARD: key b")
    page.keyboard.press("t")
    stack.wait_state(0, armed=True)
    for _ in range(80):
        page.keyboard.press("i")
    sync_api.expect(steering.locator("[data-axis=up]")).to_have_text("0.80 m/s")
    page.keyboard.press("b")
    stack.wait(lambda: stack.height(0) > 2.0, "the vehicle climbs")
    sync_api.expect(steering.locator("[data-role=deaf]")).to_have_count(0)
    steering.locator("[data-role=end]").click()
    stack.pass_time(3.0)
    before = stack.height(0)
    stack.pass_time(2.0)
    assert abs(stack.height(0) - before) < 0.4  # at 0.8 m/s it would be 1.6 m
    panel("recordings").locator("[data-role=stop]").click()
    file = poll(lambda: next(recordings.glob("*.bag"), None), "the bag is whole")
    row = page.locator(f'tr[data-file="{file.name}"] td.link')
    row.click()
    page.wait_for_selector("[data-role=player]")
    page.select_option("[data-role=player] select", "30")
    page.click("[data-role=play]")
    page.wait_for_selector(f'#stage-body[data-recording="{file.name}"]')
    poll(lambda: page.evaluate("station.replaying && station.fleet.vehicles[2] > 1.5"), "the recorded climb is shown")
    page.click("[data-role=player] button:has-text('Back')")
    assert page.evaluate("station.replaying") is False


def test_a_cut_recording_and_one_that_is_none_say_what_is_wrong(
    page: Any, panel: Callable[[str], Any], recordings: Path
) -> None:
    whole = next(recordings.glob("*.bag"))
    (recordings / "cut.bag").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    (recordings / "none.bag").write_bytes(os.urandom(1000))
    rows = panel("recordings")
    rows.locator("button", has_text="Refresh").click()
    rows.locator('tr[data-file="none.bag"] td.link').click()
    none = page.locator(".toast.bad", has_text="none.bag")
    none.click()
    sync_api.expect(none).to_have_count(0)
    rows.locator('tr[data-file="cut.bag"] td.link').click()
    # The rest of a short recording may lack a whole chunk: then it is rejected.
    told = page.locator("[data-role=player] .warn").or_(page.locator(".toast.bad", has_text="cut.bag"))
    sync_api.expect(told.first).to_be_visible()
    page.evaluate("station.call('recordings.state')")


def test_a_recording_is_opened_with_the_report_that_analyse_leaves(
    page: Any, panel: Callable[[str], Any], recordings: Path
) -> None:
    bag = next(path for path in recordings.glob("*.bag") if path.stem not in ("cut", "none"))
    subprocess.run([sys.executable, "-m", "xtdrone_interaction", "analyse", str(bag)], check=True, capture_output=True)
    rows = panel("recordings")
    rows.locator("button", has_text="Refresh").click()
    row = rows.locator(f'tr[data-file="{bag.name}"]')
    sync_api.expect(row.locator(".pill")).to_have_text("report")
    row.locator("td.link").click()
    report = page.locator("[data-role=report]")
    report.locator("summary").click()
    sync_api.expect(report.locator("[data-figure=messages] .num")).to_have_text(str(_messages(bag)))
    pictures = report.locator("img")
    expected = sorted(path.name for path in bag.with_name(f"{bag.stem}-analysis").glob("*.png"))
    assert expected
    sync_api.expect(pictures).to_have_count(len(expected), timeout=_MS)
    shown = pictures.evaluate_all("all => all.map(i => [i.alt.split('/').pop(), i.naturalWidth > 100])")
    assert shown == [[name, True] for name in expected]
    assert "is not allowed, a picture below" in page.evaluate(
        "station.call('recordings.picture', {file: '../secret.png'}).catch(error => error.message)"
    )
    page.click("[data-role=player] button:has-text('Back')")


def _messages(bag: Path) -> int:
    import rosbag

    with rosbag.Bag(str(bag)) as opened:
        return int(opened.get_message_count())


def test_a_phone_shows_every_panel_without_scrolling_sideways(page: Any, panel: Callable[[str], Any]) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    try:
        for theme in ("light", "dark"):
            page.evaluate(
                f"document.documentElement.dataset.theme === '{theme}' || document.getElementById('theme').click()"
            )
            assert page.evaluate("getComputedStyle(document.documentElement).colorScheme") == theme
            for name in page.eval_on_selector_all("#dock-tabs button", "all => all.map(b => b.dataset.panel)"):
                mount = panel(name)
                assert (name, mount.evaluate(TOO_WIDE)) == (name, [])
        assert page.evaluate("document.getElementById('bar').offsetHeight") <= 90
        table = panel("vehicles").locator("table")
        assert table.evaluate("t => t.getBoundingClientRect().top") < 600, "the table is in sight without scrolling"
    finally:
        page.set_viewport_size({"width": 1000, "height": 700})


def test_speed_step_and_the_one_that_holds_the_tick(page: Any, stack: Stack, graph: Graph) -> None:
    def state() -> str:
        return str(page.inner_text("[data-cell=time-state]"))

    def pick(selector: str, value: str) -> None:
        page.eval_on_selector(
            selector, f"e => {{ e.value = '{value}'; e.dispatchEvent(new Event('change', {{bubbles: true}})); }}"
        )

    status = graph.hear("/simulator/status", SimulationStatus)
    pick("[data-time=speed]", "3")
    stack.wait(lambda: status.last and status.last.speed == 1.0, "the slider sets the speed")
    sync_api.expect(page.locator("[data-cell=speed]")).to_have_text("1×")
    page.click("[data-time=pause]")
    stack.wait(lambda: status.last.paused and not status.last.stepping, "it is paused")
    tick = status.last.tick
    pick("#time select", "10")
    page.click("[data-time=step]")
    stack.wait(lambda: status.last.tick >= tick + 10 and not status.last.stepping, "ten ticks pass")
    assert status.last.tick == tick + 10
    page.click("[data-time=pause]")
    poll(lambda: state() == "running", "it runs")
    holder = stack.programs["typhoon_communication"].process
    holder.send_signal(signal.SIGSTOP)
    try:
        poll(lambda: state() == "held by /typhoon_communication", "the page names the one that holds the tick")
    finally:
        holder.send_signal(signal.SIGCONT)
    poll(lambda: state() == "running", "it runs again")


def test_one_vehicle_and_all_are_reset(
    page: Any, panel: Callable[[str], Any], stack: Stack, recordings: Path, graph: Graph
) -> None:
    vehicles = panel("vehicles")
    page.click("[data-action=all]")
    before = stack.time
    vehicles.locator("[data-action=reset]").click()
    sync_api.expect(page.locator(".toast", has_text=VEHICLE).last).to_be_visible(timeout=_MS)
    stack.wait_state(0, armed=False)
    stack.wait(lambda: stack.height(0) < 0.5, "it stands at its place")
    assert stack.time >= before
    choose_curve(panel("plots"))
    poll(lambda: plotted(page)[1], "samples are drawn")
    page.click("[data-time=reset]")
    page.click("#question .sure")
    stack.wait(lambda: stack.time < before, "time is set back")
    sync_api.expect(page.locator(".toast", has_text="simulated time is 0")).to_be_visible(timeout=_MS)
    poll(lambda: (times := plotted(page)[1]) and max(times) < before, "the plot starts over")
    assert not page.locator(".toast.bad").count()
