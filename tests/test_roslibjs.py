"""The rosbridge server with roslibjs in a browser, as pages use it: topics, compressions, services, parameters."""

from __future__ import annotations

import functools
import http.server
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import START_LIMIT, Graph, Stack, poll

pytest.importorskip("rospy")
pytest.importorskip("playwright")

import rospy
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool
from web_browser import CHROMIUM, FLAGS, needs_chromium

pytestmark = needs_chromium
PAGE = Path(__file__).parent / "roslibjs"
PROMISES = """
globalThis.first = (topic, options) => new Promise(done => {
  const heard = new ROSLIB.Topic({ros, name: topic, messageType: 'std_msgs/Float64MultiArray', ...options});
  heard.subscribe(message => { heard.unsubscribe(); done([...message.data].map(String)); });
});
globalThis.asked = (name, type, request) => new Promise((done, fail) =>
  new ROSLIB.Service({ros, name, serviceType: type}).callService(new ROSLIB.ServiceRequest(request), done, fail));
void 0;  // a function would be called
"""


@pytest.fixture(scope="module")
def server(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The rosbridge server and the station beside the second simulation of a machine, here without it."""
    stack = Stack(graph, tmp_path_factory.mktemp("roslibjs"))
    rospy.set_param("/xtdrone/instance", 1)
    stack.run("rosbridge_websocket", "xtdrone_interaction", "rosbridge_websocket.py")
    station = stack.run("web_station", "xtdrone_interaction", "web_station.py")
    poll(lambda: rospy.has_param("/rosbridge_websocket/actual_port"), "it listens", START_LIMIT)
    poll(lambda: "(operate): http://127.0.0.1:9182/" in station.output, "the station listens 540 ports higher")
    yield rospy.get_param("/rosbridge_websocket/actual_port")
    stack.stop()


@pytest.fixture(scope="module")
def page(server: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A page on this machine with roslibjs, connected."""
    from playwright.sync_api import sync_playwright

    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(PAGE))
    files = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=files.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        opened = browser.new_page()
        opened.goto(f"http://127.0.0.1:{files.server_address[1]}/")
        opened.evaluate(f"void (globalThis.ros = new ROSLIB.Ros({{url: 'ws://127.0.0.1:{server}'}}))")
        opened.evaluate(PROMISES)
        poll(lambda: opened.evaluate("ros.isConnected"), "roslibjs is connected")
        yield opened
        browser.close()
    files.shutdown()


def test_the_second_simulation_of_a_machine_has_ports_of_its_own(server: int) -> None:
    assert server == 9090 + 540


@pytest.mark.parametrize("compression", ["none", "png", "cbor"])
def test_it_hears_a_topic(page: Any, graph: Graph, compression: str) -> None:
    publisher = rospy.Publisher(f"/tried/{compression}", Float64MultiArray, queue_size=1, latch=True)
    publisher.publish(Float64MultiArray(data=[1.5, -2.0, 0.0]))
    heard = page.evaluate(f"first('/tried/{compression}', {{compression: '{compression}'}})")
    assert heard == ["1.5", "-2", "0"]
    publisher.unregister()


def test_it_publishes_calls_and_offers(page: Any, graph: Graph) -> None:
    heard = graph.hear("/tried/from_roslibjs", String)
    page.evaluate(
        "new ROSLIB.Topic({ros, name: '/tried/from_roslibjs', messageType: 'std_msgs/String'})"
        ".publish(new ROSLIB.Message({data: 'hello'}))"
    )
    poll(lambda: heard.last and heard.last.data == "hello", "the message arrives")
    service = rospy.Service("/tried/answers", SetBool, lambda request: (not request.data, "answered"))
    assert page.evaluate("asked('/tried/answers', 'std_srvs/SetBool', {data: false})") == {
        "success": True,
        "message": "answered",
    }
    service.shutdown()
    assert "no such service" in page.evaluate("asked('/tried/none', 'std_srvs/SetBool', {}).catch(String)")
    page.evaluate(
        "globalThis.offered = new ROSLIB.Service({ros, name: '/tried/offered', serviceType: 'std_srvs/SetBool'});"
        "offered.advertise((request, response) =>"
        " { response.success = request.data; response.message = 'js'; return true; })"
    )
    answer = graph.call("/tried/offered", SetBool, data=True)
    assert (answer.success, answer.message) == (True, "js")


def test_it_reads_the_graph_and_parameters(page: Any) -> None:
    topics = page.evaluate("new Promise((done, fail) => ros.getTopics(done, fail))")
    assert dict(zip(topics["topics"], topics["types"], strict=True))["/rosout"] == "rosgraph_msgs/Log"
    page.evaluate("new ROSLIB.Param({ros, name: '/tried/number'}).set(2.5)")
    poll(lambda: rospy.get_param("/tried/number", None) == 2.5, "the parameter is set")
    assert page.evaluate("new Promise(done => new ROSLIB.Param({ros, name: '/tried/number'}).get(done))") == 2.5
    details = page.evaluate("new Promise((d, f) => ros.getMessageDetails('geometry_msgs/Twist', d, f))")
    assert details[0]["fieldnames"] == ["linear", "angular"]
