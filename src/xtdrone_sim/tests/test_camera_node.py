"""The cameras' node with a real master in lockstep; this file plays the simulator.

Run as a program, this file is one of the other nodes: ``teller`` publishes the scene, ``taker`` receives one camera's
pictures, and ``slow`` is the cameras' node with a renderer that waits for lines on standard input.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from graph_of_nodes import (
    PATIENCE,
    Graph,
    needs_ros,
    read_notes,
    run_ticks,
    running_graph,
    running_server,
    wait_for_nodes,
    wait_until,
)

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.frames import to_xyzw
from xtdrone_common.rotation import from_euler
from xtdrone_lockstep.server import LockstepServer

try:
    import rospy
    from geometry_msgs.msg import Point, Pose, Quaternion
    from sensor_msgs.msg import CameraInfo, Image
    from std_srvs.srv import SetBool
    from xtdrone_msgs.msg import SceneState
except ImportError:
    rospy = None

pytestmark = needs_ros

NODE = Path(__file__).parents[1] / "nodes" / "cameras.py"
FLEET = "typhoon_h480:2"
CAMERA = "/typhoon_h480_0/cgo3_camera"
RATE = 5.0
NAMES = ["/cameras", "/teller", "/taker"]
BLURRED = """
extends: typhoon_h480
cameras:
  - {name: cgo3_camera, link: cgo3_camera_link, width: 160, height: 90, hfov: 2.0, exposure: 0.02, exposure_pictures: 3}
"""


def teller() -> None:
    """Publish the cameras' poses; the cameras turn downwards, so the horizon moves up in the picture."""
    lockstep.init_node("teller", rate=50.0)
    publisher = lockstep.Publisher("/xtdrone/scene", SceneState)
    links = [f"{vehicle.name}::cgo3_camera_link" for vehicle in parse_fleet(FLEET)]

    def step() -> None:
        now = rospy.Time.now()
        message = SceneState(links=links)
        message.header.stamp = now
        for k in range(len(links)):
            turn = Quaternion(*to_xyzw(from_euler(0.0, 0.3 * now.to_sec(), 0.0)))
            message.poses.append(Pose(Point(3.0 * k, 0.0, 2.0), turn))
        publisher.publish(message)

    lockstep.start()
    lockstep.spin(step)


def taker(file: str, freeze: str, thaw: str) -> None:
    """Record the first camera's messages, a JSON line each; freeze and restore it at these times, s."""
    lockstep.init_node("taker", rate=50.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def note(what: str, message: Any, **values: Any) -> None:
        times = {"now": rospy.Time.now().to_nsec() // 1000, "stamp": message.header.stamp.to_nsec() // 1000}
        print(json.dumps({"what": what, **times, "frame": message.header.frame_id, **values}), file=out)

    def on_image(message: Image) -> None:
        digest = hashlib.sha256(message.data).hexdigest()
        form = [message.height, message.width, message.encoding, message.step, len(message.data)]
        note("image", message, form=form, digest=digest)

    keep = [
        lockstep.Subscriber(f"{CAMERA}/image_raw", Image, on_image),
        lockstep.Subscriber(f"{CAMERA}/camera_info", CameraInfo, lambda m: note("info", m, k=m.K, p=m.P)),
    ]
    lockstep.add_reset_hook(lambda: print(json.dumps({"what": "back"}), file=out))
    lockstep.start()
    switch = rospy.ServiceProxy(f"{CAMERA}/freeze", SetBool)

    def step() -> None:
        for at, frozen in ((freeze, True), (thaw, False)):
            if rospy.Time.now() == rospy.Time.from_sec(float(at)):
                assert switch(frozen).success
        print(json.dumps({"what": "turn", "now": rospy.Time.now().to_nsec() // 1000}), file=out)

    lockstep.spin(step)
    del keep


def slow(file: str) -> None:
    """Run the cameras' node; each picture, of no content, waits for a line of standard input."""
    from xtdrone_sim.cameras.camera_node import CameraNode, CameraSettings
    from xtdrone_sim.cameras.cameras_of_fleet import cameras_of

    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    class Drawer:
        ended, last_end = 0, ""

        def draw(self, scene: Any, view: Any) -> bytes | None:
            print(view.link, file=out)
            return bytes(3 * 640 * 360) if sys.stdin.readline() else None

        def close(self) -> None:
            out.close()

    lockstep.init_node("cameras", rate=10.0)
    node = CameraNode(cameras_of(parse_fleet(FLEET)), CameraSettings(rate=RATE, latency=0.3), 10.0)
    lockstep.start()
    node.begin(Drawer())
    lockstep.spin(node.step)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    yield from running_graph(tmp_path)


@pytest.fixture
def server(graph: Graph) -> Iterator[LockstepServer]:
    yield from running_server(graph)


def test_pictures_have_exact_times_and_repeat_after_a_reset(graph: Graph, server: LockstepServer) -> None:
    graph.set_param("/xtdrone/fleet", FLEET)
    graph.set_param("/cameras", {"rate": RATE, "backend": "tiny"})
    file = graph.folder / "taker.json"
    graph.start("cameras", sys.executable, str(NODE))
    graph.role(__file__, "teller")
    graph.role(__file__, "taker", str(file), "0.54", "0.86")
    wait_for_nodes(graph, server, NAMES)
    length = 1_400_000
    run_ticks(graph, server, 0, length, len(NAMES))
    server.reset_time(0)
    run_ticks(graph, server, 0, length, len(NAMES))
    notes = read_notes(file)
    back = [note["what"] for note in notes].index("back")
    flights = [[note for note in part if note["what"] == "image"] for part in (notes[:back], notes[back:])]
    infos = [note for note in notes[:back] if note["what"] == "info"]
    # Exposed at 0.1, 0.3, ... s, from the scene of 20 ms before; published 0.1 s later, received one turn on. It is
    # frozen after the exposure at 0.5 s, between turns of the node, and that picture is not published either.
    for images in flights:
        assert [image["stamp"] for image in images] == [80_000, 280_000, 880_000, 1_080_000]
        assert [image["now"] - image["stamp"] for image in images] == [140_000] * 4
        assert {tuple(image["form"]) for image in images} == {(360, 640, "rgb8", 1920, 640 * 360 * 3)}
        assert len({image["digest"] for image in images}) == 4  # no two are the same
    assert [i["digest"] for i in flights[0]] == [i["digest"] for i in flights[1]]
    assert [info["stamp"] for info in infos] == [image["stamp"] for image in flights[0]]
    assert {note["frame"] for note in infos + flights[0]} == {"typhoon_h480_0/cgo3_camera_optical_frame"}
    focal = 320.0 / math.tan(1.0)
    assert infos[0]["k"] == pytest.approx([focal, 0, 320, 0, focal, 180, 0, 0, 1])
    assert infos[0]["p"] == pytest.approx([focal, 0, 320, 0, 0, focal, 180, 0, 0, 0, 1, 0])


def test_a_blurred_picture_has_the_middle_of_its_exposure_and_repeats(graph: Graph, server: LockstepServer) -> None:
    (graph.folder / "typhoon_h480.yaml").write_text(BLURRED)
    graph.env["XTDRONE_VEHICLES"] = str(graph.folder)
    graph.set_param("/xtdrone/fleet", FLEET)
    graph.set_param("/cameras", {"rate": RATE, "backend": "tiny"})
    file = graph.folder / "taker.json"
    graph.start("cameras", sys.executable, str(NODE))
    graph.role(__file__, "teller")
    graph.role(__file__, "taker", str(file), "99", "99")
    wait_for_nodes(graph, server, NAMES)
    run_ticks(graph, server, 0, 700_000, len(NAMES))
    server.reset_time(0)
    run_ticks(graph, server, 0, 700_000, len(NAMES))
    notes = read_notes(file)
    back = [note["what"] for note in notes].index("back")
    flights = [[note for note in part if note["what"] == "image"] for part in (notes[:back], notes[back:])]
    # The shutter closes at the scene of 20 ms before the node's turn, 10 ms after the middle.
    assert [image["stamp"] for image in flights[0]] == [70_000, 270_000, 470_000]
    assert [image["digest"] for image in flights[0]] == [image["digest"] for image in flights[1]]
    assert len({image["digest"] for image in flights[0]}) == 3


def test_flight_continues_while_a_picture_is_drawn_and_only_for_subscribers(
    graph: Graph, server: LockstepServer
) -> None:
    graph.set_param("/xtdrone/fleet", FLEET)
    file, drawn = graph.folder / "taker.json", graph.folder / "drawn.txt"
    drawing = graph.role(__file__, "slow", str(drawn), stdin=subprocess.PIPE)
    assert drawing.stdin is not None
    graph.role(__file__, "teller")
    graph.role(__file__, "taker", str(file), "99", "99")
    wait_for_nodes(graph, server, NAMES)
    run_ticks(
        graph, server, 0, 400_000, len(NAMES)
    )  # it ends although the picture exposed at 0.1 s, due at 0.4 s, is not drawn
    wait_until(lambda: len(drawn.read_text().splitlines()) == 1, "the first picture is begun")
    turns = [note["now"] for note in read_notes(file) if note["what"] == "turn"]
    assert turns[-1] == 380_000
    drawing.stdin.write(b"\n" * 20)
    drawing.stdin.flush()
    run_ticks(graph, server, 400_000, 900_000, len(NAMES))
    notes = read_notes(file)
    images = [(note["now"], note["stamp"]) for note in notes if note["what"] == "image"]
    assert images == [(420_000, 80_000), (620_000, 280_000), (820_000, 480_000)]
    assert set(drawn.read_text().splitlines()) == {"typhoon_h480_0::cgo3_camera_link"}  # the other has no subscriber


def test_a_fleet_without_cameras_is_reported(graph: Graph) -> None:
    graph.set_param("/cameras/fleet", "iris:2")
    node = graph.start("cameras", sys.executable, str(NODE))
    assert node.wait(PATIENCE) == 2
    assert "no vehicle of 'iris:2' has a camera" in (graph.folder / "cameras.out").read_text()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"rate": 99}, "~rate: 99 is not allowed, 0, or 0.1 to 50 Hz"),
        ({"rate": True}, "~rate: True is not allowed"),
        ({"latency": -1.0}, "~latency: -1.0 is not allowed, 0 to 10 s"),
        ({"backend": "gl"}, "~backend: 'gl' is not allowed, auto, egl or tiny"),
    ],
)
def test_invalid_parameters_are_reported(parameters: dict[str, Any], words: str) -> None:
    from xtdrone_sim.cameras.camera_node import CameraSettings

    with pytest.raises(ValueError, match=re.escape(words)):
        CameraSettings.from_parameters(lambda name, default: parameters.get(name[1:], default))


def main() -> None:
    """Run a node."""
    {"teller": teller, "taker": taker, "slow": slow}[sys.argv[1]](*sys.argv[2:])


if __name__ == "__main__":
    main()
