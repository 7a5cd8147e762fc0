"""MAVLink endpoints on more than one machine: bound addresses, and rejections."""

from __future__ import annotations

import socket

import pytest

from xtdrone_autopilot.mavlink.udp_port_and_clients import LinkError, Port
from xtdrone_mavros.link import autopilot_links
from xtdrone_mavros.link.autopilot_links import FcuUrl, bind_host_for
from xtdrone_mavros.mavros_node import connections


@pytest.fixture
def resolver(monkeypatch: pytest.MonkeyPatch) -> None:
    """Resolve two host names without a name server."""
    known = {"localhost": "127.0.0.1", "127.0.0.1": "127.0.0.1", "0.0.0.0": "0.0.0.0", "elsewhere": "255.255.255.255"}

    def look_up(name: str) -> str:
        if name not in known:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return known[name]

    monkeypatch.setattr(autopilot_links.socket, "gethostbyname", look_up)


@pytest.mark.usefixtures("resolver")
class TestBindHost:
    def test_local_autopilots_are_received_on_loopback(self):
        assert bind_host_for("127.0.0.1") == "127.0.0.1"
        assert bind_host_for("localhost") == "127.0.0.1"

    def test_a_host_name_without_an_address_is_reported(self):
        with pytest.raises(
            autopilot_links.AutopilotLinkError, match=r"fcu_host: 'nowhere' has no IPv4 address: Name or service"
        ):
            bind_host_for("nowhere")

    def test_an_unreachable_host_is_reported_with_its_address(self):
        # A plain socket must not broadcast; this address stands for every unreachable one.
        with pytest.raises(
            autopilot_links.AutopilotLinkError, match=r"fcu_host: 'elsewhere' \(255\.255\.255\.255\) cannot be reached"
        ):
            bind_host_for("elsewhere")

    def test_an_address_of_another_machine_cannot_be_bound(self):
        with pytest.raises(autopilot_links.AutopilotLinkError, match=r"bind_host: '192\.0\.2\.1' cannot be bound"):
            bind_host_for("127.0.0.1", "192.0.2.1")


def test_the_fleets_links_lead_to_the_autopilots_machine(monkeypatch):
    monkeypatch.setattr("xtdrone_mavros.mavros_node.bind_host_for", lambda fcu_host, bind_host: bind_host or "0.0.0.0")
    first, second = connections({"fcu_host": "sim.example"}, "iris:2", "/mavros")
    assert first.url == FcuUrl("0.0.0.0", 24540, "sim.example", 34580)
    assert second.url == FcuUrl("0.0.0.0", 24541, "sim.example", 34581)
    (own,) = connections({"fcu_host": "sim.example", "bind_host": "10.1.2.3"}, "iris:1", "/mavros")
    assert own.url.bind_host == "10.1.2.3"


def test_the_fleets_links_are_local_by_default():
    (link,) = connections({}, "iris:1", "/mavros")
    assert link.url == FcuUrl("127.0.0.1", 24540, "127.0.0.1", 34580)


def test_the_fleets_links_may_have_ports_of_their_own():
    settings = {"fleet_url": "udp://:14540@px4.example:14580", "fcu_host": "sim.example"}
    first, second = connections(settings, "iris:2", "/mavros")
    assert (first.name, first.url) == ("iris_0", FcuUrl("0.0.0.0", 14540, "px4.example", 14580))
    assert (second.name, second.url) == ("iris_1", FcuUrl("0.0.0.0", 14541, "px4.example", 14581))
    assert second.target == (2, 1)


def test_a_fleet_has_no_ports_beyond_the_highest():
    with pytest.raises(
        autopilot_links.AutopilotLinkError, match="fleet_url: vehicle 1 would get port 65536, at most 65535"
    ):
        connections({"fleet_url": "udp://:65535@:14580"}, "iris:2", "/mavros")


class _NoTelemetry:
    """Stand-in for a vehicle without telemetry."""

    protocol = 0

    def refresh(self) -> None:
        """Read nothing."""

    def source(self, _name: str):
        return lambda: None


def _port(host: str, port: int) -> Port:
    from xtdrone_common.fleet import Vehicle

    return Port(Vehicle("iris", 0, 0), "offboard", port, 24540, _NoTelemetry(), {"HEARTBEAT": 1.0}, host)


def test_an_autopilots_link_is_bound_to_the_given_address(free_port):
    for host in ("127.0.0.1", "0.0.0.0"):
        port = _port(host, free_port)
        assert port.socket.getsockname() == (host, free_port)
        port.close()


def test_an_autopilots_link_on_another_machines_address_is_rejected(free_port):
    with pytest.raises(LinkError, match=rf"UDP port {free_port} cannot be bound on 192\.0\.2\.1.*of this machine"):
        _port("192.0.2.1", free_port)


def test_a_link_points_where_it_is_directed_until_its_client_speaks(free_port):
    port = _port("127.0.0.1", free_port)
    assert port.default.peer == ("127.0.0.1", 24540)
    port.direct("10.0.0.2", 0)
    assert port.default.peer == ("10.0.0.2", 24540)
    other = port.link_of(("10.0.0.3", 4711), 0)
    other.heard(0, 2)
    port.direct("10.0.0.4", 0)
    port.default.heard(0, 2)
    port.direct("10.0.0.5", 0)
    assert [link.peer for link in port.links] == [("10.0.0.4", 24540), ("10.0.0.3", 4711)]
    port.direct("10.0.0.5", 0, override=True)
    assert [link.peer for link in port.links] == [("10.0.0.5", 24540), ("10.0.0.3", 4711)]
    port.close()


def test_a_client_that_sent_before_the_link_was_redirected_to_it_keeps_its_link(free_port):
    port = _port("127.0.0.1", free_port)
    early = port.link_of(("10.0.0.2", 24540), 0)
    early.heard(0, 2)
    port.direct("10.0.0.2", 0)
    assert port.links == [early]
    assert port.default is early
    port.close()


@pytest.fixture
def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
