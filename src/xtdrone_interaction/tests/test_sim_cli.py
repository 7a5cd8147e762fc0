"""``xtdrone sim`` without a simulation: values that are not allowed, and masters that are none."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from xtdrone_interaction import sim_cli


class _WebPage(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = b"welcome & come in"
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def web_server():
    """Give the address of a server that is no ROS master."""
    server = HTTPServer(("127.0.0.1", 0), _WebPage)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_web_server_is_no_ros_master(web_server, capsys):
    assert sim_cli.main(["status", "--master", web_server]) == 1
    assert f"what answers at {web_server} is no ROS master" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "end"),
    [
        ("--until", "1e12", "4294967296"),
        ("--until", "4294967296", "4294967296"),
        ("--for", "2147483648", "2147483648"),
        ("--for", "inf", "2147483648"),
        ("--for", "0", "2147483648"),
        ("--for", "nan", "2147483648"),
    ],
)
def test_times_that_ros_cannot_hold_are_refused(option, value, end, capsys):
    with pytest.raises(SystemExit) as ended:
        sim_cli.main(["step", option, value])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert f"{value!r} is not allowed; a number of seconds above 0 and below {end}" in said
