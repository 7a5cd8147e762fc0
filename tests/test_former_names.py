"""What users' scripts, launch files and C++ nodes say about packages before their rooms moved still works."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import rospkg
from test_architecture import ALLOWED, ROOT

import xtdrone_control
import xtdrone_sim
from xtdrone_common.former_names import redirect

MODULES = {
    "xtdrone_control.lockstep": "xtdrone_lockstep",
    "xtdrone_control.lockstep.server": "xtdrone_lockstep.server",
    "xtdrone_control.fleet": "xtdrone_common.fleet",
    "xtdrone_control.frames": "xtdrone_common.frames",
    "xtdrone_control.settings": "xtdrone_common.settings",
    "xtdrone_control.autopilot.modes": "xtdrone_common.modes",
    "xtdrone_control.autopilot.parameters.parameters": "xtdrone_autopilot.parameters.parameters",
    "xtdrone_control.mavlink.mavlink_server": "xtdrone_autopilot.mavlink.mavlink_server",
    "xtdrone_control.mavros.mavros_node": "xtdrone_mavros.mavros_node",
    "xtdrone_sim.worlds.sdf": "xtdrone_worlds.worlds.sdf",
}
NODES = [
    ("xtdrone_control", "mavros_node.py"),
    ("xtdrone_control", "multirotor_communication.py"),
    ("xtdrone_control", "lockstep_idle"),
    ("xtdrone_control", "lockstep_idle.py"),
    ("xtdrone_control", "fleet_text.py"),
    ("xtdrone_sim", "simulator.py"),
    ("xtdrone_coordination", "avoid_cpp"),
    ("xtdrone_interaction", "web_station.py"),
    ("xtdrone_interaction", "foxglove_bridge.py"),
    ("xtdrone_interaction", "rosbridge_websocket.py"),
    ("xtdrone_interaction", "ros2_bridge.py"),
    ("xtdrone_interaction", "record.py"),
    ("xtdrone_interaction", "recorder"),
]
FILES = [
    ("xtdrone_sim", "worlds/outdoor.world"),
    ("xtdrone_sim", "models/iris/iris.urdf"),
    ("xtdrone_sim", "config/vehicles/iris.yaml"),
    ("xtdrone_sim", "config/robots/ugv.yaml"),
    ("xtdrone_control", "mavros/launch/px4_pluginlists.yaml"),
    ("xtdrone_interaction", "config/record_profiles/light.yaml"),
    ("xtdrone_interaction", "config/foxglove/formation.json"),
]


@pytest.mark.parametrize(("former", "name"), MODULES.items())
def test_a_module_has_its_former_name_too(former, name):
    assert importlib.import_module(former) is importlib.import_module(name)
    assert importlib.import_module(name).__spec__.name == name


def test_a_user_of_the_former_names_gets_the_same_classes():
    program = (
        "from xtdrone_control import drone, lockstep\n"
        "from xtdrone_control.lockstep import Publisher\n"
        "from xtdrone_coordination.follower import Follower\n"
        "from xtdrone_coordination.leader import Leader\n"
        "import xtdrone_lockstep\n"
        "assert lockstep is xtdrone_lockstep and Publisher is xtdrone_lockstep.Publisher\n"
        "assert callable(drone.connect)\n"
    )
    subprocess.run([sys.executable, "-W", "error::ImportWarning", "-c", program], check=True)


def test_every_redirection_leads_to_a_module():
    assert xtdrone_control
    assert xtdrone_sim
    finders = [finder for finder in sys.meta_path if type(finder).__name__ == "_Redirection"]
    assert {former.split(".")[0] for finder in finders for former in finder.moved} >= {
        "xtdrone_control",
        "xtdrone_sim",
    }
    for finder in finders:
        for name in finder.moved.values():
            assert importlib.util.find_spec(name) is not None, name


def test_a_name_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"xtdrone_control\.nothing"):
        importlib.import_module("xtdrone_control.nothing")
    with pytest.raises(ModuleNotFoundError, match="nothing"):
        importlib.import_module("xtdrone_control.lockstep.nothing")


def test_a_redirection_adds_one_name(monkeypatch):
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    redirect("xtdrone_common", {"angles": "xtdrone_common.rotation"})
    assert importlib.import_module("xtdrone_common.angles").__name__ == "xtdrone_common.rotation"
    sys.modules.pop("xtdrone_common.angles")


@pytest.mark.parametrize(("package", "node"), NODES)
def test_a_node_starts_under_its_former_package(package, node):
    found = subprocess.run(["catkin_find", "--first-only", "--libexec", package, node], capture_output=True, text=True)
    assert found.stdout.strip(), f"rosrun {package} {node}"


@pytest.mark.parametrize(("package", "file"), FILES)
def test_a_file_is_found_below_its_former_package(package, file):
    assert (Path(rospkg.RosPack().get_path(package)) / file).is_file()


def test_former_headers_compile(tmp_path):
    source = tmp_path / "node.cpp"
    source.write_text(
        "#include <xtdrone_control/lockstep.h>\n"
        "namespace lockstep = xtdrone_control::lockstep;\n"
        'int main(int argc, char** argv) { lockstep::init(argc, argv, "node", 30.0); }\n'
    )
    includes = [f"-I{ROOT / 'src' / package / 'include'}" for package in ("xtdrone_control", "xtdrone_lockstep")]
    subprocess.run(["g++", "-std=c++17", "-fsyntax-only", *includes, "-I/usr/include", str(source)], check=True)


def test_every_package_is_listed():
    assert {path.parent.name for path in ROOT.glob("src/xtdrone_*/setup.py")} == set(ALLOWED)
