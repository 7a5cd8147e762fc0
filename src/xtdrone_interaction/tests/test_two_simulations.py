"""Two simulations on one machine: their stations and bridges share no port, no DDS domain and no file."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rospy")

from xtdrone_interaction import server_port
from xtdrone_interaction.bridges.foxglove import foxglove_node
from xtdrone_interaction.bridges.ros2 import ros2_node
from xtdrone_interaction.bridges.rosbridge import rosbridge_node
from xtdrone_interaction.web import station_settings
from xtdrone_interaction.web.recordings import recorder_process
from xtdrone_interaction.web.recordings.recorder_process import RecorderProcess

PORTS = (station_settings.DEFAULT_PORT, foxglove_node.PORT, rosbridge_node.PORT)


def test_every_instance_has_ports_and_a_domain_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    ports, domains = [], []
    for instance in range(8):
        monkeypatch.setattr(server_port.rospy, "get_param", lambda *_, i=instance: i)
        ports += [server_port.port_here(port, port) for port in PORTS]
        domains.append(ros2_node._domain())
    assert len(set(ports)) == 8 * len(PORTS)
    assert domains == list(range(8))
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert ros2_node._domain() == 42


def test_recordings_that_begin_in_the_same_second_have_names_of_their_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(recorder_process.time, "strftime", lambda _: "20260101-120000")
    monkeypatch.setattr(recorder_process.shutil, "which", lambda _: "/bin/true")
    names = []
    for instance in range(2):
        recorder = RecorderProcess(tmp_path, "http://127.0.0.1:9")
        recorder.start("light", instance)
        names.append(recorder.stop())
    assert names == ["20260101-120000-light", "20260101-120000-light-1"]
