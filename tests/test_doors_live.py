"""The servers against foreign web pages in a browser, names that ROS does not know, and readers of tokens."""

from __future__ import annotations

import contextlib
import functools
import http.server
import json
import os
import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import START_LIMIT, Graph, Stack, poll

pytest.importorskip("rospy")
pytest.importorskip("websockets")

import rospy
from foxglove_client import FoxgloveClient
from std_msgs.msg import String
from web_browser import CHROMIUM, FLAGS, needs_chromium
from websockets.sync.client import connect

NUL = "/tried/\0"
SECRET = "not-to-be-told"


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """The three servers without a simulation, on any free ports."""
    graph.forget()
    stack = Stack(graph, tmp_path_factory.mktemp("doors"))
    rospy.set_param("/tried/access_token", SECRET)
    for node, program in (("rosbridge_websocket", "rosbridge_websocket.py"), ("foxglove_bridge", "foxglove_bridge.py")):
        stack.run(node, "xtdrone_interaction", program, "_port:=0")
    station = stack.run("web_station", "xtdrone_interaction", "web_station.py", "_port:=0")
    poll(lambda: "station (operate)" in station.output, "the station listens", START_LIMIT)
    for node in ("rosbridge_websocket", "foxglove_bridge"):
        poll(lambda node=node: rospy.has_param(f"/{node}/actual_port"), f"{node} listens", START_LIMIT)
    yield stack
    stack.stop()


@pytest.fixture(scope="module")
def ports(stack: Stack) -> dict[str, int]:
    found = re.search(r"http://127\.0\.0\.1:(\d+)/", stack.programs["web_station"].output)
    assert found is not None
    return {
        "station": int(found[1]),
        "rosbridge": rospy.get_param("/rosbridge_websocket/actual_port"),
        "foxglove": rospy.get_param("/foxglove_bridge/actual_port"),
    }


class Page:
    """A program in the place of the station's page."""

    def __init__(self, port: int) -> None:
        self._exit = contextlib.ExitStack()
        connection = connect(f"ws://127.0.0.1:{port}/ws", ping_interval=None, max_size=None)
        self._socket = self._exit.enter_context(connection)
        self.call("hello", token="")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._socket.send(json.dumps({"id": 1, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60.0))
            if answer.get("id") == 1:
                return dict(answer)

    def close(self) -> None:
        self._exit.close()


def test_a_name_that_the_master_cannot_read_stops_no_server(ports: dict[str, int], graph: Graph) -> None:
    with connect(f"ws://127.0.0.1:{ports['rosbridge']}", ping_interval=None) as socket:
        for op, field, more in (
            ("advertise", "topic", {"type": "std_msgs/String"}), ("subscribe", "topic", {}),
            ("advertise_service", "service", {"type": "std_srvs/Empty"}), ("call_service", "service", {}),
        ):  # fmt: skip
            socket.send(json.dumps({"op": op, field: NUL, **more}))
            assert "is not allowed, a name such as" in str(socket.recv(timeout=60.0))
    foxglove = FoxgloveClient(ports["foxglove"])
    channels = [{"id": i, "topic": name, "encoding": "ros1", "schemaName": "std_msgs/String"}
                for i, name in ((1, NUL), (2, "/tried/from_foxglove"))]  # fmt: skip
    heard = {name: graph.hear(f"/tried/from_{name}", String) for name in ("rosbridge", "foxglove", "station")}
    foxglove.send({"op": "advertise", "channels": channels})
    foxglove.publish(1, b"\0\0\0\0")
    foxglove.publish(2, b"\x02\0\0\0ok")
    foxglove.wait(lambda: "is not allowed, a name such as" in str(foxglove.frames))
    page = Page(ports["station"])
    for name in (NUL, "/a b", "", "~a"):
        assert "is not allowed" in page.call("topics.publish", topic=name, type="std_msgs/String")["error"]
        assert "is not allowed" in page.call("topics.echo", topic=name)["error"]
        assert "is not allowed" in page.call("parameters.set_ros", name=name, value=1)["error"]
    message = {"data": "ok"}
    page.call("topics.publish", topic="/tried/from_station", type="std_msgs/String", message=message)
    with connect(f"ws://127.0.0.1:{ports['rosbridge']}", ping_interval=None) as socket:
        topic = {"topic": "/tried/from_rosbridge"}
        socket.send(json.dumps({"op": "advertise", **topic, "type": "std_msgs/String"}))
        socket.send(json.dumps({"op": "publish", **topic, "msg": message}))
        for name, ear in heard.items():
            poll(lambda ear=ear: ear.last and ear.last.data == "ok", f"{name} goes on")
    foxglove.close()
    page.close()


def test_a_token_on_the_parameter_server_is_told_by_no_server(ports: dict[str, int]) -> None:
    page = Page(ports["station"])
    answer = page.call("parameters.ros")
    assert "/rosbridge_websocket/actual_port" in answer["result"]["values"]
    assert SECRET not in str(answer)
    page.close()
    foxglove = FoxgloveClient(ports["foxglove"])
    for i, names in enumerate(([], ["/tried/access_token"])):
        foxglove.send({"op": "getParameters", "parameterNames": names, "id": str(i)})
        foxglove.wait(lambda i=i: foxglove.last("parameterValues", id=str(i)))
    foxglove.send({"op": "subscribeParameterUpdates", "parameterNames": ["/tried/access_token", "/tried/open"]})
    rospy.set_param("/tried/access_token", f"{SECRET}-2")
    rospy.set_param("/tried/open", "told")
    foxglove.wait(lambda: "'value': 'told'" in str(foxglove.frames))
    assert SECRET not in str(foxglove.frames)
    foxglove.close()
    with connect(f"ws://127.0.0.1:{ports['rosbridge']}", ping_interval=None, max_size=None) as socket:
        for service, name in (("get_param", "/"), ("get_param", "/tried"), ("get_param", "/tried/access_token"),
                              ("has_param", "/tried/access_token"), ("get_param_names", "")):  # fmt: skip
            call = {"op": "call_service", "service": f"/rosapi/{service}", "args": {"name": name} if name else {}}
            socket.send(json.dumps(call))
            answer = json.loads(socket.recv(timeout=60.0))
            assert SECRET not in str(answer)
            assert answer["result"] is (not name.endswith("token"))


def test_a_token_in_a_parameter_ends_the_station_with_advice(stack: Stack) -> None:
    program = stack.run("second_station", "xtdrone_interaction", "web_station.py", "_port:=0", f"_token:={SECRET}")
    assert program.end() == 2
    assert "put it into the environment variable XTDRONE_WEB_TOKEN, or into a file of mode 600" in program.output
    assert SECRET not in program.output
    assert not rospy.has_param("/second_station/token")


# ---- foreign pages

OPENED = """([url, protocol]) => new Promise(done => {
  const socket = new WebSocket(url, protocol ? [protocol] : []);
  socket.onopen = () => { socket.close(); done('open'); };
  socket.onerror = () => done('refused');
})"""
FETCHED = "url => fetch(url, {mode: 'cors'}).then(answer => String(answer.status), () => 'unreadable')"
PROTOCOLS = {"foxglove": "foxglove.sdk.v1"}


class _Files(http.server.SimpleHTTPRequestHandler):
    """Serves files without a log."""

    def log_message(self, *_: Any) -> None:
        """Log nothing."""


@needs_chromium
def test_a_foreign_page_in_a_browser_reaches_no_server(ports: dict[str, int], stack: Stack, tmp_path: Path) -> None:
    sync_playwright = pytest.importorskip("playwright.sync_api").sync_playwright
    (tmp_path / "index.html").write_text("<title>a page</title>")
    handler = functools.partial(_Files, directory=str(tmp_path))
    files = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=files.serve_forever, daemon=True).start()
    flags = [*FLAGS, "--host-resolver-rules=MAP evil.example 127.0.0.1"]  # as rebinding points the name here
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page()

        def outcomes(origin: str, host: str) -> dict[str, str]:
            page.goto(f"http://{origin}:{files.server_address[1]}/")
            return {
                name: page.evaluate(OPENED, [f"ws://{host}:{port}/ws", PROTOCOLS.get(name, "")])
                for name, port in ports.items()
            }

        refused = dict.fromkeys(ports, "refused")
        assert outcomes("evil.example", "127.0.0.1") == refused
        assert outcomes("evil.example", "evil.example") == refused
        assert outcomes("127.0.0.1", "127.0.0.1") == {**refused, "foxglove": "open", "rosbridge": "open"}
        for name, port in ports.items():  # rebinding: the page itself has the server's name and port
            answer = page.goto(f"http://evil.example:{port}/")
            assert answer is not None
            assert answer.status == 403, name
            socket = f"ws://evil.example:{port}/ws"
            assert page.evaluate(OPENED, [socket, PROTOCOLS.get(name, "")]) == "refused", name
            assert page.evaluate(FETCHED, f"http://evil.example:{port}/") in ("403", "unreadable")
        page.goto(f"http://127.0.0.1:{ports['station']}/")
        poll(lambda: page.evaluate("Boolean(globalThis.station && station.connected)"), "the own page is connected")
        browser.close()
    files.shutdown()
    log = stack.programs["foxglove_bridge"].output
    assert f"origins:=http://evil.example:{files.server_address[1]} allows it" in log


def test_a_server_that_waits_for_the_master_ends_by_sigterm(stack: Stack, graph: Graph) -> None:
    program = stack.run("hung_rosbridge", "xtdrone_interaction", "rosbridge_websocket.py", "_port:=0")
    poll(lambda: rospy.has_param("/hung_rosbridge/actual_port"), "it listens", START_LIMIT)
    port = rospy.get_param("/hung_rosbridge/actual_port")
    master = _rosmaster(graph.port)
    with connect(f"ws://127.0.0.1:{port}", ping_interval=None, close_timeout=0.1) as socket:
        socket.send(json.dumps({"op": "advertise", "topic": "/tried/warm", "type": "std_msgs/String"}))
        poll(lambda: "/tried/warm" in str(rospy.get_published_topics()), "it is advertised")
        os.kill(master, signal.SIGSTOP)
        try:
            socket.send(json.dumps({"op": "subscribe", "topic": "/tried/hung", "type": "std_msgs/String"}))
            program.process.send_signal(signal.SIGTERM)
            program.end(60.0)
        finally:
            os.kill(master, signal.SIGCONT)


def _rosmaster(port: int) -> int:
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            words = (entry / "cmdline").read_bytes().split(b"\0") if (entry / "cmdline").exists() else []
            if any(b"rosmaster" in word for word in words) and str(port).encode() in words:
                return int(entry.name)
    raise AssertionError("the master's process is not found")
