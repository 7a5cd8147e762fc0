"""``xtdrone sim`` without a simulation: values that are not allowed, and addresses without a ROS master."""

from __future__ import annotations

import socket
import threading
import types
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from xtdrone_interaction import cli, service_client, sim_cli, simulation_services


class _WebPage(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = b"welcome & come in"
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture
def web_server():
    """Yield the address of a server that is not a ROS master."""
    server = HTTPServer(("127.0.0.1", 0), _WebPage)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_web_server_is_no_ros_master(web_server, capsys):
    assert cli.main(["sim", "status", "--master", web_server]) == 1
    assert f"the server at {web_server} is not a ROS master" in capsys.readouterr().err


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
def test_times_beyond_the_range_of_ros_are_rejected(option, value, end, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["sim", "step", option, value])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert f"{value!r} is not allowed, above 0 and below {end} s" in said


def test_a_flight_elsewhere_is_found_until_it_ends(tmp_path):
    runs, flight = tmp_path / "runs", tmp_path / "elsewhere" / "flight"
    flight.mkdir(parents=True)
    master = flight / simulation_services.MASTER_FILE
    master.write_text("http://127.0.0.1:1\n")
    pointer = simulation_services.announce(flight, runs)
    assert list(simulation_services.flights([runs])) == [master]
    master.unlink()  # killed: the pointer to it remains
    assert list(simulation_services.flights([runs])) == []
    stale = pointer.rename(pointer.with_name("1"))
    simulation_services.announce(flight, runs)
    assert not stale.exists()


def test_a_flight_in_runs_needs_no_pointer(tmp_path):
    assert simulation_services.announce(tmp_path / "flight", tmp_path) is None


@pytest.mark.parametrize(
    ("values", "state"),
    [
        ({}, "running"),
        ({"paused": True, "reason": "paused"}, "paused"),
        ({"paused": True, "stepping": True}, "stepping, then paused"),
        ({"reason": "time has not started: 1 of 3 participants have joined"}, "waiting for participants"),
        ({"waiting_for": ["/a"], "reason": "waiting for /a (1.0 s)"}, "waiting"),
    ],
)
def test_the_state_as_text(values, state):
    plain = {"paused": False, "stepping": False, "waiting_for": [], "reason": ""}
    assert sim_cli._state(types.SimpleNamespace(**{**plain, **values})) == state


def test_the_exceeded_limit_is_reported(monkeypatch):
    from std_srvs.srv import Trigger, TriggerRequest

    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setattr(simulation_services, "find_service", lambda master, name: silent.getsockname())
        monkeypatch.setattr(service_client, "CONNECTION_LIMIT", 0.125)
        with pytest.raises(simulation_services.SimError, match=r"/simulator/pause has not answered within 0\.125 s"):
            simulation_services.call("http://127.0.0.1:1", "/simulator/pause", Trigger, TriggerRequest())


def test_ctrl_c_during_a_step_is_reported_and_the_step_continues(monkeypatch, capsys):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sim_cli, "call", interrupted)
    assert cli.main(["sim", "step", "--for", "100", "--master", "11311"]) == 130
    assert "the step continues; './xtdrone sim pause' ends it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("offered", "words", "wanted"),
    [
        ("failure", ["iris_0/scan", "biased", "0.5"], ("/iris_0/scan/failure", ("biased", 0.5))),
        ("failure", ["/iris_0/scan", "ok"], ("/iris_0/scan/failure", ("ok", 0.0))),
        ("freeze", ["iris_0/camera", "off"], ("/iris_0/camera/freeze", (True,))),
        ("freeze", ["iris_0/camera", "ok"], ("/iris_0/camera/freeze", (False,))),
        ("freeze", ["iris_0/camera", "biased"], "failure: 'biased' is not allowed for a camera, off or ok"),
        ("", ["iris_0/scan", "off"], "no lidar, camera or UWB sensor 'iris_0/scan' runs"),
    ],
)
def test_sensors_fail_by_the_service_that_they_offer(offered, words, wanted, monkeypatch, capsys):
    asked = []

    def answer(master, service, kind, request):
        asked.append((service, tuple(getattr(request, name) for name in request.__slots__)))
        return types.SimpleNamespace(success=True, message="done")

    monkeypatch.setattr(sim_cli, "find_service", lambda master, name: ("", 1) if offered and offered in name else None)
    monkeypatch.setattr(sim_cli, "choose_master", lambda *_: ("http://127.0.0.1:1", ""))
    monkeypatch.setattr(sim_cli, "call", answer)
    status = cli.main(["sim", "fail", *words])
    if isinstance(wanted, str):
        assert status == 1
        assert wanted in capsys.readouterr().err
    else:
        assert (status, asked) == (0, [wanted])
