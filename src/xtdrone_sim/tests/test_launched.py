"""The simulator's reading of the parameters of a launch in XTDrone's form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from xtdrone_common.fleet import FleetError
from xtdrone_sim.runtime.launched_vehicles import launched_world, read_launched
from xtdrone_worlds.descriptions import ModelError, read_description


def group(number: int, sdf: str = "iris") -> dict[str, Any]:
    own = {"vehicle": "iris", "sdf": sdf, "ID": number, "ID_in_group": number, "x": 3 * number}
    own |= {"mavlink_udp_port": 18570 + number, "mavlink_tcp_port": 4560 + number}
    return {key: str(value) for key, value in own.items()}


def mavros(number: int, **changes: Any) -> dict[str, Any]:
    url = f"udp://:{24540 + number}@localhost:{34580 + number}"
    return {"launch_key": f"mavros_{number}", "fcu_url": url, "target_system_id": number + 1} | changes


def parameters(first: dict[str, Any], second: dict[str, Any], sdf: str = "iris") -> dict[str, Any]:
    """Return a parameter tree with two vehicles, their MAVROS nodes, and a vehicle left by an earlier launch."""
    return {
        "xtdrone": {
            "spawned": {"a": group(1), "b": group(0, sdf)},
            "launched_mavros": {"mavros_0": True, "mavros_1": True},
        },
        "iris_0": {"mavros": first},
        "iris_1": {"mavros": second},
        "iris_2": {"mavros": mavros(2)},
        "rosversion": "1.15",
    }


def test_time_waits_for_the_launch_s_own_mavros_nodes() -> None:
    launched = read_launched(parameters(mavros(0), mavros(1)))
    assert [vehicle.name for vehicle in launched.fleet] == ["iris_0", "iris_1"]
    assert launched.mavros == ("/iris_0/mavros", "/iris_1/mavros")
    assert launched.warnings == ()


def test_two_mavros_nodes_on_one_port() -> None:
    with pytest.raises(FleetError, match="/iris_0/mavros and /iris_1/mavros both have the local port 24540"):
        read_launched(parameters(mavros(0), mavros(1, fcu_url="udp://:24540@localhost:34581")))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fcu_url": "udp://:24541@localhost:14580"}, "no vehicle has the port 14580 of its fcu_url; theirs are 34580"),
        ({"target_system_id": 1}, "tgt_system 1 is not that of iris_1 at its fcu_url, 2"),
    ],
)
def test_a_mavros_node_without_its_vehicle_is_named(changes: dict[str, Any], words: str) -> None:
    (warning,) = read_launched(parameters(mavros(0), mavros(1, **changes))).warnings
    assert warning.startswith("/iris_1/mavros: ")
    assert words in warning


def test_models_with_sensors_fly_as_their_base() -> None:
    for name in ("iris_stereo_camera", "solo_stereo_camera", "iris_zhihang", "typhoon_h480_realsense"):
        base = "typhoon_h480" if name.startswith("typhoon") else name.split("_")[0]
        own, those = (read_description("vehicles", one) for one in (name, base))
        for sensors in ("cameras", "lidars", "imus"):
            own.pop(sensors, None)
            those.pop(sensors, None)
        assert own == those


def test_a_missing_sensor_is_named() -> None:
    with pytest.raises(ModelError, match=r"'tailsitter' is not known, a VTOL aircraft is not simulated; there"):
        read_description("vehicles", "tailsitter")
    with pytest.raises(ModelError, match="'iri' is not known; there are"):
        read_description("vehicles", "iri")


def test_worlds_are_found_as_by_gazebo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert launched_world("outdoor") == "outdoor"
    assert launched_world("worlds/indoor1.world") == "indoor1"
    ours = Path(launched_world("worlds/empty.world"))
    assert ours.parts[-3:] == ("mavlink_sitl_gazebo", "worlds", "empty.world")
    (tmp_path / "worlds").mkdir()
    theirs = tmp_path / "worlds" / "indoor9.world"
    theirs.touch()
    absent = str(ours.with_name("indoor9.world"))
    with pytest.raises(
        ModelError, match=r"indoor9.world does not exist; there are ego_swarm, .*set GAZEBO_RESOURCE_PATH"
    ):
        launched_world(absent)
    monkeypatch.setenv("GAZEBO_RESOURCE_PATH", f"/nowhere:{tmp_path}")
    assert launched_world(absent) == str(theirs)
