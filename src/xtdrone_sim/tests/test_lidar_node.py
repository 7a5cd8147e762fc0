"""The lidars' node with a real master in lockstep; this file plays the simulator.

Run as a program, this file is one of the other nodes: ``teller`` publishes the scene, ``taker`` receives scans,
``inviter`` has a vehicle join and leave, and ``watcher`` receives every vehicle's scans.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graph_of_nodes import Graph, needs_ros, read_notes, run_ticks, running_graph, running_server, wait_for_nodes

import xtdrone_lockstep as lockstep
from xtdrone_lockstep.server import LockstepServer

try:
    import rospy
    from geometry_msgs.msg import Point, Pose, Quaternion
    from sensor_msgs.msg import LaserScan
    from std_msgs.msg import String
    from xtdrone_msgs.msg import SceneState
    from xtdrone_msgs.srv import SetLidarFailure
except ImportError:
    rospy = None

pytestmark = needs_ros

NODE = Path(__file__).parents[1] / "nodes" / "lidars.py"
SPEED = 2.0  # m/s, towards the other vehicle
APART = 10.0  # m
GUEST = (4.0, 3.0, 2.03)  # m


def teller() -> None:
    """Publish the vehicles' poses: the first flies to the second, which stands."""
    lockstep.init_node("teller", rate=50.0)
    publisher = lockstep.Publisher("/xtdrone/scene", SceneState)

    def step() -> None:
        now = rospy.Time.now()
        message = SceneState(links=["iris_2d_lidar_0::base_link", "iris_2d_lidar_1::base_link"])
        message.header.stamp = now
        level = Quaternion(0.0, 0.0, 0.0, 1.0)
        message.poses = [Pose(Point(SPEED * now.to_sec(), 0.0, 2.0), level), Pose(Point(APART, 0.05, 2.06), level)]
        publisher.publish(message)

    lockstep.start()
    lockstep.spin(step)


def taker(file: str) -> None:
    """Record the scans of the first vehicle, a JSON line each; let its lidar fail from 0.5 s on."""
    lockstep.init_node("taker", rate=50.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def on_scan(message: LaserScan) -> None:
        times = {"now": rospy.Time.now().to_nsec() // 1000, "stamp": message.header.stamp.to_nsec() // 1000}
        ahead = message.ranges[len(message.ranges) // 2]
        digest = hashlib.sha256(np.array(message.ranges).tobytes()).hexdigest()
        note = {"what": "scan", **times, "frame": message.header.frame_id, "ahead": ahead, "digest": digest}
        print(json.dumps(note), file=out)

    keep = lockstep.Subscriber("/iris_2d_lidar_0/scan", LaserScan, on_scan)
    lockstep.add_reset_hook(lambda: print(json.dumps({"what": "back"}), file=out))
    lockstep.start()
    fail = rospy.ServiceProxy("/iris_2d_lidar_0/scan/failure", SetLidarFailure)

    def step() -> None:
        for at, failure in ((0.5, "off"), (0.7, "frozen"), (0.94, "ok")):
            if rospy.Time.now() == rospy.Time.from_sec(at):
                assert fail(failure, 0.0).success
        if rospy.Time.now() == rospy.Time.from_sec(0.2):
            refused = fail("broken", 0.0), fail("biased", 1e9), fail("dropouts", -1.0)
            print(json.dumps({"what": "refused", "words": [answer.message for answer in refused]}), file=out)
            assert not any(answer.success for answer in refused)

    lockstep.spin(step)
    del keep


def inviter(unusable: str) -> None:
    """Publish the vehicles' poses; in the second flight two vehicles join at 0.32 s and leave at 0.92 s.

    Args:
        unusable: description file of the second vehicle, which cannot be loaded, so that no lidar detects the vehicle.
    """
    lockstep.init_node("inviter", rate=50.0)
    publisher = lockstep.Publisher("/xtdrone/scene", SceneState)
    vehicles = lockstep.Publisher("/xtdrone/vehicles", String, latch=True)
    flights = [0]
    lockstep.add_reset_hook(lambda: flights.append(0))

    def step() -> None:
        now = rospy.Time.now()
        ms = now.to_nsec() // 1_000_000
        places = [(SPEED * now.to_sec(), 0.0, 2.0), (APART, 0.05, 2.06)]
        if len(flights) == 2 and 320 <= ms < 920:
            places.append(GUEST)
        if len(flights) == 2 and ms in (320, 920):
            fleet = [{"name": f"iris_2d_lidar_{k}"} for k in range(len(places))]
            vehicles.publish(
                String(json.dumps([*fleet, {"name": "iris_9", "model": unusable}] if ms == 320 else fleet))
            )
        message = SceneState(links=[f"iris_2d_lidar_{k}::base_link" for k in range(len(places))])
        message.header.stamp = now
        message.poses = [Pose(Point(*place), Quaternion(0.0, 0.0, 0.0, 1.0)) for place in places]
        publisher.publish(message)

    lockstep.start()
    lockstep.spin(step)


def watcher(file: str) -> None:
    """Record the scans of three vehicles, a JSON line each, and the time of the connection to the third.

    In the second flight, send requests that are rejected.
    """
    lockstep.init_node("watcher", rate=50.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def on_scan(message: LaserScan, vehicle: int) -> None:
        stamp = message.header.stamp.to_nsec() // 1000
        note = {"vehicle": vehicle, "stamp": stamp, "frame": message.header.frame_id, "ranges": list(message.ranges)}
        print(json.dumps(note), file=out)

    keep = [lockstep.Subscriber(f"/iris_2d_lidar_{k}/scan", LaserScan, on_scan, k) for k in range(3)]
    flights = [0]

    def come_back() -> None:
        flights.append(0)
        print(json.dumps({"back": keep[2].get_num_connections()}), file=out)

    lockstep.add_reset_hook(come_back)
    lockstep.start()
    fail = rospy.ServiceProxy("/iris_2d_lidar_0/scan/failure", SetLidarFailure)

    def step() -> None:
        if rospy.Time.now() == rospy.Time.from_sec(0.6) and len(flights) == 2:
            refused = fail("broken", 0.0), fail("biased", math.nan), fail("dropouts", 1.5)
            assert not any(answer.success for answer in refused)
        if rospy.Time.now() == rospy.Time.from_sec(0.8):
            print(json.dumps({"connected": keep[2].get_num_connections()}), file=out)

    lockstep.spin(step)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    yield from running_graph(tmp_path)


@pytest.fixture
def server(graph: Graph) -> Iterator[LockstepServer]:
    yield from running_server(graph)


def test_scans_have_exact_times_fail_on_request_and_repeat_after_a_reset(graph: Graph, server: LockstepServer) -> None:
    graph.set_param("/xtdrone/fleet", "iris_2d_lidar:2")
    file = graph.folder / "taker.json"
    graph.start("lidars", sys.executable, str(NODE))
    graph.role(__file__, "teller")
    graph.role(__file__, "taker", str(file))
    names = ["/lidars", "/teller", "/taker"]
    wait_for_nodes(graph, server, names)
    for _ in range(2):
        run_ticks(graph, server, 0, 1_300_000, len(names))
        server.reset_time(0)
    notes = read_notes(file)
    back = [note["what"] for note in notes].index("back")
    parts = notes[:back], notes[back:]
    flights = [[note for note in part if note["what"] == "scan"] for part in parts]
    # A scan lasts 0.1 s, and is published 0.04 s after the scene of its end, received in the next turn; those due
    # from 0.5 to 0.7 s are not published, those until 0.94 s have the ranges of the last one.
    stamps = [note["stamp"] for note in flights[0]]
    assert stamps == [0, 100_000, 200_000, 300_000, 600_000, 700_000, 800_000, 900_000, 1_000_000, 1_100_000]
    assert len({note["now"] - note["stamp"] for note in flights[0]}) == 1
    assert {note["frame"] for note in flights[0]} == {"iris_2d_lidar_0/laser_2d"}
    assert [note["digest"] for note in flights[0]] == [note["digest"] for note in flights[1]]
    frozen = {note["digest"] for note in flights[0] if note["stamp"] in (600_000, 700_000)}
    assert frozen == {flights[0][3]["digest"]}
    for note in flights[0][:4] + flights[0][-2:]:
        # The forward ray is the middle one, at half of the scan, and points a little left. The other's body begins
        # 0.13 m before its centre.
        expected = APART - 0.13 - SPEED * (note["stamp"] * 1e-6 + 0.05)
        assert note["ahead"] == pytest.approx(expected, abs=0.05)  # noise of 0.01 m
    (refused, _) = [note["words"] for note in notes if note["what"] == "refused"]
    assert "failure: 'broken' is not allowed, ok, off, frozen, biased or dropouts" in refused[0]
    assert "value: 1000000000.0 is not allowed, -100 to 100 m" in refused[1]
    assert "value: -1.0 is not allowed, 0 to 1" in refused[2]


def test_a_vehicle_that_joins_scans_and_is_seen_until_it_leaves(graph: Graph, server: LockstepServer) -> None:
    graph.set_param("/xtdrone/fleet", "iris_2d_lidar:2")
    file = graph.folder / "watcher.json"
    graph.start("lidars", sys.executable, str(NODE))
    unusable = graph.folder / "unusable.yaml"
    (graph.folder / "pattern.csv").write_text("time,azimuth,zenith\n0,0,90\n0.1,nan,90\n")
    unusable.write_text("extends: iris\nlidars: [{name: livox, kind: pattern, pattern: pattern.csv}]\n")
    graph.role(__file__, "inviter", str(unusable))
    graph.role(__file__, "watcher", str(file))
    names = ["/lidars", "/inviter", "/watcher"]
    wait_for_nodes(graph, server, names)
    for _ in range(2):
        run_ticks(graph, server, 0, 1_300_000, len(names))
        server.reset_time(0)
    run_ticks(graph, server, 0, 40_000, len(names))
    notes = read_notes(file)
    assert [note["connected"] for note in notes if "connected" in note] == [0, 1]
    assert [note["back"] for note in notes if "back" in note] == [0, 0]  # the publisher is gone
    back = next(k for k, note in enumerate(notes) if "back" in note)
    alone, joined = (
        {(note["vehicle"], note["stamp"]): note for note in part if "vehicle" in note}
        for part in (notes[:back], notes[back:])
    )
    guests = {key for key in joined if key[0] == 2}
    assert sorted(stamp for _, stamp in guests) == [400_000, 500_000, 600_000, 700_000]  # whole scans, 0.32 to 0.92 s
    assert {joined[key]["frame"] for key in guests} == {"iris_2d_lidar_2/laser_2d"}
    assert joined.keys() - guests == alone.keys()
    towards = np.array(joined[2, 500_000]["ranges"])
    assert towards.min() == pytest.approx(math.dist(GUEST[:2], (APART, 0.05)) - 0.13, abs=0.1)  # the second vehicle
    for key, note in alone.items():
        before, after = np.array(note["ranges"]), np.array(joined[key]["ranges"])
        nearer = after != before
        assert np.all(after[nearer] < before[nearer])  # only the guest's rays change
        # Neither a vehicle that cannot be loaded nor rejected requests change anything.
        assert nearer.any() == (key[0] == 0 and 300_000 <= key[1] <= 800_000), key  # the second lidar looks over it
    said = graph.output()
    assert "iris_9 is not served by /lidars" in said
    assert "pattern.csv: line 3: '0.1,nan,90' is not allowed, three numbers" in said


def test_a_fleet_without_lidars_is_reported(graph: Graph) -> None:
    graph.set_param("/lidars/fleet", "iris:2")
    node = graph.start("lidars", sys.executable, str(NODE))
    assert node.wait(120.0) == 2
    assert "no vehicle of 'iris:2' has a lidar" in graph.output()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"rate": 99}, "~rate: 99 is not allowed, 0, or 0.1 to 50 Hz"),
        ({"rate": 0.01}, "~rate: 0.01 is not allowed"),
        ({"latency": math.nan}, "~latency: nan is not allowed, 0 to 10 s"),
        ({"skew": 1}, "~skew: 1 is not allowed, true or false"),
    ],
)
def test_invalid_parameters_are_reported(parameters: dict[str, Any], words: str) -> None:
    from xtdrone_sim.lidars.lidar_node import LidarSettings

    with pytest.raises(ValueError, match=re.escape(words)):
        LidarSettings.from_parameters(lambda name, default: parameters.get(name[1:], default))


def main() -> None:
    """Run a node."""
    {"teller": teller, "taker": taker, "inviter": inviter, "watcher": watcher}[sys.argv[1]](*sys.argv[2:])


if __name__ == "__main__":
    main()
