"""The detection node with a real master in lockstep: a simulated camera, a network with known outputs.

Run as a program, this file is one of the other nodes: ``eyes`` (a vehicle with its camera) or ``recorder``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from perception_stack import PATIENCE, Stack, wait_until
from tiny_networks import write_darknet

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import camera_link_pose, mount_orientation, optical_pose
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.frames import to_xyzw
from xtdrone_perception.tracking.geolocation import Geolocator, View

try:
    import rospy
    from darknet_ros_msgs.msg import BoundingBoxes, ObjectCount
    from geometry_msgs.msg import PoseStamped, Quaternion
    from mavros_msgs.msg import State
    from sensor_msgs.msg import CameraInfo, Image
    from std_msgs.msg import Bool
    from xtdrone_msgs.msg import ObjectsOnGround
except ImportError:
    rospy = None

pytestmark = pytest.mark.skipif(rospy is None, reason="needs ROS 1 and the built workspace")

NODE = Path(__file__).parents[1] / "nodes" / "yolo.py"
NAME = "typhoon_h480_0"
PINHOLE = Pinhole.of_view(640, 360, 2.0)
MOUNT = mount_orientation(0.0, -1.0, 0.0)
SPEED = 2.0  # m/s, along x
EXPOSURE = 0.05  # s before its message
CELL = (12, 4)  # of the person, 32 px each, in the network's input


def place_at(seconds: float) -> tuple[float, float, float]:
    return SPEED * seconds, 1.0, 20.0


def picture() -> np.ndarray:
    rgb = np.zeros((360, 640, 3), np.uint8)
    x, y = 32 * CELL[0] + 16, 32 * CELL[1] + 16 - 12  # 12 px of grey above it in the input
    rgb[y - 4 : y + 4, x - 4 : x + 4] = (255, 0, 0)
    return rgb


def eyes(pictures: str) -> None:
    """Simulate a vehicle in flight; ``pictures``: JSON of [from, to, number of 20 ms steps per picture], s."""
    lockstep.init_node("eyes", rate=50.0)
    phases = json.loads(pictures)
    pose = lockstep.Publisher(f"/{NAME}/mavros/local_position/pose", PoseStamped)
    mount = lockstep.Publisher(f"/{NAME}/mavros/mount_control/orientation", Quaternion)
    state = lockstep.Publisher(f"/{NAME}/mavros/state", State)
    info = lockstep.Publisher(f"/{NAME}/cgo3_camera/camera_info", CameraInfo)
    image = lockstep.Publisher(f"/{NAME}/cgo3_camera/image_raw", Image)
    rgb = picture()
    matrix = [PINHOLE.fx, 0, PINHOLE.cx, 0, PINHOLE.fy, PINHOLE.cy, 0, 0, 1]

    def step() -> None:
        now = rospy.Time.now()
        message = PoseStamped()
        message.header.stamp = now
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = place_at(now.to_sec())
        q.w = 1.0
        pose.publish(message)
        mount.publish(Quaternion(*to_xyzw(MOUNT)))
        state.publish(State(armed=True))
        turn = round(now.to_sec() * 50.0)
        if any(begin <= now.to_sec() < end and turn % every == 0 for begin, end, every in phases):
            shot = Image(height=360, width=640, encoding="rgb8", step=1920)
            shot.header.stamp = now - rospy.Duration.from_sec(EXPOSURE)
            rgb[0, 0] = 0, turn // 256, turn % 256  # all pictures differ
            shot.data = rgb.tobytes()
            about = CameraInfo(width=640, height=360, K=matrix)
            about.header.stamp = shot.header.stamp
            info.publish(about)
            image.publish(shot)

    lockstep.start()
    lockstep.spin(step)


def recorder(file: str) -> None:
    """Record the messages of the detection node, one JSON line each."""
    lockstep.init_node("recorder", rate=50.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def note(topic: str, **values: object) -> None:
        print(json.dumps({"now": rospy.get_time(), "topic": topic, **values}), file=out)

    def on_boxes(message: BoundingBoxes) -> None:
        boxes = [[b.Class, b.probability, b.xmin, b.ymin, b.xmax, b.ymax] for b in message.bounding_boxes]
        note("boxes", stamp=message.image_header.stamp.to_sec(), done=message.header.stamp.to_sec(), boxes=boxes)

    def on_objects(message: ObjectsOnGround) -> None:
        found = [
            [o.id, o.object_class, o.hits, o.position.x, o.position.y, o.position.z, *o.covariance]
            for o in message.objects
        ]
        camera = message.camera.position
        stamp = message.header.stamp.to_sec()
        note("objects", stamp=stamp, dropped=message.dropped, camera=[camera.x, camera.y, camera.z], objects=found)

    def on_image(message: Image) -> None:
        rgb = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
        red = np.flatnonzero(((rgb[..., 0] == 255) & (rgb[..., 1] == 60)).any(axis=0))
        note("image", stamp=message.header.stamp.to_sec(), first=int(red[0]) if len(red) else -1)

    keep = [
        lockstep.Subscriber("/uav_0/darknet_ros/bounding_boxes", BoundingBoxes, on_boxes),
        lockstep.Subscriber("/uav_0/darknet_ros/found_object", ObjectCount, lambda m: note("count", count=m.count)),
        lockstep.Subscriber("/uav_0/darknet_ros/detection_image", Image, on_image),
        lockstep.Subscriber(f"/xtdrone/{NAME}/objects", ObjectsOnGround, on_objects),
        lockstep.Subscriber(f"/xtdrone/{NAME}/camera_ok", Bool, lambda m: note("ok", ok=m.data)),
    ]
    lockstep.add_reset_hook(lambda: note("back"))
    lockstep.start()
    lockstep.spin()
    del keep


# tests


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    stack = Stack(tmp_path)
    yield stack
    stack.stop()


@pytest.fixture
def network(stack: Stack) -> None:
    """Detects a human of 8 x 12 px in the middle of a red cell."""
    biases = np.array([0.0, 0.0, 0.0, 0.0, -6.0, 6.0])
    weights = np.zeros((6, 3))
    weights[4, 0] = 12.0
    cfg, path = write_darknet(stack.folder, width=640, height=384, anchors=[(8, 12)], classes=1,
                              weights=weights, biases=biases)  # fmt: skip
    (stack.folder / "tiny.names").write_text("human\n")
    settings = stack.folder / "tiny.yaml"
    settings.write_text(f"weights: {path.name}\nconfig: {cfg.name}\nnames: tiny.names\n")
    stack.set("/yolo/detector", str(settings))


def begin(stack: Stack, phases: list) -> None:
    """Start the nodes and wait for them."""
    stack.start("recorder", sys.executable, __file__, "recorder", str(stack.record))
    stack.start("eyes", sys.executable, __file__, "eyes", json.dumps(phases))
    stack.start("yolo", sys.executable, str(NODE), "typhoon_h480", "0", "__name:=yolo")
    stack.wait_for("/eyes", "/recorder", "/yolo")


def expected_box() -> tuple[float, float, float, float]:
    x, y = 32 * CELL[0] + 16, 32 * CELL[1] + 16 - 12
    return x - 4.0, y - 6.0, x + 4.0, y + 6.0


def expected_place(stamp: float) -> np.ndarray:
    """Return the position of the person in the box, from the camera pose at the exposure."""
    link = camera_link_pose(place_at(stamp), (1.0, 0.0, 0.0, 0.0), MOUNT, (0.041, 0.0, -0.122))
    return Geolocator().locate(View.of(PINHOLE, *optical_pose(link)), expected_box()).position


def test_results_are_published_on_time_and_repeat_after_a_reset(stack, network):
    begin(stack, [[0.5, 10.0, 25]])  # 2 Hz
    stack.run(4.0)
    stack.server.reset_time(0)
    stack.run(4.0)
    records = stack.lines()
    back = next(i for i, line in enumerate(records) if line["topic"] == "back")
    assert records[:back] == records[back + 1 :]

    first = records[:back]
    boxes = [line for line in first if line["topic"] == "boxes"]
    sent = [0.5 + 0.5 * k for k in range(7)]
    assert [line["stamp"] for line in boxes] == pytest.approx([t - EXPOSURE for t in sent])
    # One step to the node, 0.1 s of latency.
    assert [line["done"] for line in boxes] == pytest.approx([t + 0.02 + 0.1 for t in sent])
    ((name, probability, *corners),) = boxes[0]["boxes"]
    assert (name, corners) == ("human", list(expected_box()))
    assert probability == pytest.approx((1 / (1 + np.exp(-6.0))) ** 2)
    assert [line["count"] for line in first if line["topic"] == "count"] == [1] * 7
    images = [line for line in first if line["topic"] == "image"]
    assert [(line["stamp"], line["first"]) for line in images] == [(b["stamp"], corners[0]) for b in boxes]
    assert [line["ok"] for line in first if line["topic"] == "ok"] == [True]

    objects = [line for line in first if line["topic"] == "objects"]
    assert [line["stamp"] for line in objects] == [line["stamp"] for line in boxes]
    assert [len(line["objects"]) for line in objects] == [0, 0, 1, 1, 1, 1, 1]
    assert objects[0]["camera"] == pytest.approx([2.0 * 0.45 + 0.041, 1.0, 19.878])
    # The object moves with the picture; the track is at its observed position, within its uncertainty.
    for line in objects[2:]:
        identity, kind, _, *numbers = line["objects"][0]
        assert (identity, kind) == (1, "human")
        error = np.array(numbers[:2]) - expected_place(line["stamp"])[:2]
        covariance = np.array(numbers[3:]).reshape(3, 3)[:2, :2]
        assert error @ np.linalg.solve(covariance, error) < 4.0
    assert objects[-1]["objects"][0][2] == 7

    stack.end("yolo")


def test_surplus_pictures_are_dropped_and_a_silent_camera_is_reported(stack, network):
    begin(stack, [[0.51, 2.51, 2]])  # 25 Hz, then none
    stack.run(6.5)
    records = stack.lines()
    objects = [line for line in records if line["topic"] == "objects"]
    boxes = [line for line in records if line["topic"] == "boxes"]
    # 50 pictures: processing takes five steps, then the newest picture is next.
    sent = [0.52 + 0.04 * k - EXPOSURE for k in range(50)]
    numbers = [int(np.argmin([abs(line["stamp"] - stamp) for stamp in sent])) for line in boxes]
    assert numbers[0] == 0
    assert numbers[-1] == 49
    assert set(np.diff(numbers[:-1])) <= {2, 3}
    assert all(line["done"] - line["stamp"] < EXPOSURE + 0.02 + 0.04 + 0.1 + 1e-6 for line in boxes)
    assert objects[-1]["dropped"] == 50 - len(boxes)
    assert [line["ok"] for line in records if line["topic"] == "ok"] == [True, False]
    (told,) = [line["now"] for line in records if line["topic"] == "ok" and not line["ok"]]
    assert 2.5 + 3.0 < told < 2.5 + 3.1
    wait_until(lambda: "no image for more than 3 s, in flight" in stack.output("yolo"), "the warning is written")


def test_invalid_parameters_are_reported(stack, network):
    stack.master.deleteParam("/test", "/lockstep/uri")
    wrong = [
        (["typhoon_h480", "0"], "detector", "/nowhere/none.yaml", "/nowhere/none.yaml: No such file"),
        (["typhoon_h480", "0"], "latency", -1.0, "/latency: -1.0 is not allowed, 0 to 10 s"),
        (["typhoon_h480", "0"], "noise", {"pixels": 1.0}, "noise: {'pixels': 1.0} is not allowed"),
    ]
    for number, (arguments, name, value, _) in enumerate(wrong):
        stack.set(f"/yolo_{number}/detector", stack.master.getParam("/test", "/yolo/detector")[2])
        stack.set(f"/yolo_{number}/{name}", value)
        stack.start(f"yolo_{number}", sys.executable, str(NODE), *arguments, f"__name:=yolo_{number}")
    for number, (*_, message) in enumerate(wrong):
        output = f"yolo_{number}"
        assert stack.processes[output].wait(PATIENCE) == 2, stack.output(output)
        assert message in stack.output(output)
        assert "usage: yolo.py TYPE ID" in stack.output(output)
        assert "Traceback" not in stack.output(output)


if __name__ == "__main__":
    {"eyes": eyes, "recorder": recorder}[sys.argv[1]](sys.argv[2])
