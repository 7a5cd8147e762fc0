"""The UWB sensors' node with a real master in lockstep; this file plays the simulator.

Run as a program, this file is one of the other nodes: ``teller`` publishes the scene, ``taker`` receives ranges,
``inviter`` has a vehicle join and leave, and ``watcher`` receives every vehicle's ranges.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from graph_of_nodes import Graph, needs_ros, read_notes, run_ticks, running_graph, running_server, wait_for_nodes

import xtdrone_lockstep as lockstep
from xtdrone_lockstep.server import LockstepServer

try:
    import rospy
    from geometry_msgs.msg import Point, Pose, Quaternion
    from std_msgs.msg import String
    from xtdrone_msgs.msg import RelativeRanges, SceneState
    from xtdrone_msgs.srv import SetLidarFailure
except ImportError:
    rospy = None

pytestmark = needs_ros

NODE = Path(__file__).parents[1] / "nodes" / "uwb.py"
NAMES = ("iris_uwb_bearing_0", "iris_uwb_bearing_1", "iris_uwb_bearing_2")
SPEED = 2.0  # m/s, of the first vehicle, ahead
RATE = 8.0  # Hz: most measurements are between two scenes


def places(time: float) -> list[tuple[float, float, float]]:
    """Return the positions of the vehicles, m; the third is out of range."""
    return [(SPEED * time, 0.0, 2.0), (10.0, 10.0, 2.0), (100.0, 0.0, 2.0)]


def teller() -> None:
    """Publish the vehicles' poses."""
    lockstep.init_node("teller", rate=50.0)
    publisher = lockstep.Publisher("/xtdrone/scene", SceneState)

    def step() -> None:
        now = rospy.Time.now()
        message = SceneState(links=[f"{name}::base_link" for name in NAMES])
        message.header.stamp = now
        message.poses = [Pose(Point(*place), Quaternion(0.0, 0.0, 0.0, 1.0)) for place in places(now.to_sec())]
        publisher.publish(message)

    lockstep.start()
    lockstep.spin(step)


def taker(file: str) -> None:
    """Record the ranges of the first vehicle, a JSON line each; let sensors fail between measurements."""
    lockstep.init_node("taker", rate=50.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def on_ranges(message: RelativeRanges) -> None:
        note = {"what": "ranges", "stamp": message.header.stamp.to_nsec() // 1000, "frame": message.header.frame_id}
        note["ranges"] = [[r.vehicle, r.frame_id, r.range, r.azimuth, r.elevation] for r in message.ranges]
        print(json.dumps(note), file=out)

    keep = lockstep.Subscriber(f"/{NAMES[0]}/uwb", RelativeRanges, on_ranges)
    lockstep.add_reset_hook(lambda: print(json.dumps({"what": "back"}), file=out))
    lockstep.start()
    own, other = (rospy.ServiceProxy(f"/{name}/uwb/failure", SetLidarFailure) for name in NAMES[:2])

    def step() -> None:
        for at, fail, failure, value in (
            (0.2, own, "broken", 0.0),
            (0.56, own, "frozen", 0.0),
            (0.8, own, "biased", 5.0),
            (1.06, other, "off", 0.0),
            (1.2, own, "off", 0.0),
            (1.4, other, "ok", 0.0),
            (1.4, own, "ok", 0.0),
        ):
            if rospy.Time.now().to_nsec() == round(at * 1e9):
                answer = fail(failure, value)
                assert answer.success == (failure != "broken")
                print(json.dumps({"what": "answer", "words": answer.message}), file=out)

    lockstep.spin(step)
    del keep


def inviter() -> None:
    """Publish the vehicles' poses; in the second flight the third joins at 0.32 s and leaves at 0.92 s."""
    lockstep.init_node("inviter", rate=50.0)
    publisher = lockstep.Publisher("/xtdrone/scene", SceneState)
    vehicles = lockstep.Publisher("/xtdrone/vehicles", String, latch=True)
    flights = [0]
    lockstep.add_reset_hook(lambda: flights.append(0))

    def step() -> None:
        now = rospy.Time.now()
        ms = now.to_nsec() // 1_000_000
        there = NAMES[: 3 if len(flights) == 2 and 320 <= ms < 920 else 2]
        if len(flights) == 2 and ms in (320, 920):
            vehicles.publish(String(f"iris_uwb_bearing:{len(there)}"))
        message = SceneState(links=[f"{name}::base_link" for name in there])
        message.header.stamp = now
        spots = [(0.0, 0.0, 2.0), (10.0, 10.0, 2.0), (0.0, 7.0, 2.0)]
        message.poses = [Pose(Point(*spots[k]), Quaternion(0.0, 0.0, 0.0, 1.0)) for k in range(len(there))]
        publisher.publish(message)

    lockstep.start()
    lockstep.spin(step)


def watcher(file: str) -> None:
    """Record the ranges of all vehicles, a JSON line each."""
    lockstep.init_node("watcher", rate=50.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def on_ranges(message: RelativeRanges) -> None:
        ranges = {r.vehicle: [r.range, r.azimuth, r.elevation] for r in message.ranges}
        stamp = message.header.stamp.to_nsec() // 1000
        print(json.dumps({"vehicle": message.vehicle, "stamp": stamp, "ranges": ranges}), file=out)

    keep = [lockstep.Subscriber(f"/{name}/uwb", RelativeRanges, on_ranges) for name in NAMES]
    lockstep.add_reset_hook(lambda: print(json.dumps({"back": keep[2].get_num_connections()}), file=out))
    lockstep.start()
    lockstep.spin()


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    yield from running_graph(tmp_path)


@pytest.fixture
def server(graph: Graph) -> Iterator[LockstepServer]:
    yield from running_server(graph)


def test_ranges_have_exact_times_fail_on_request_and_repeat_after_a_reset(graph: Graph, server: LockstepServer) -> None:
    graph.set_param("/xtdrone/fleet", "iris_uwb_bearing:3")
    graph.set_param("/uwb/rate", RATE)
    file = graph.folder / "taker.json"
    graph.start("uwb", sys.executable, str(NODE))
    graph.role(__file__, "teller")
    graph.role(__file__, "taker", str(file))
    names = ["/uwb", "/teller", "/taker"]
    wait_for_nodes(graph, server, names)
    for _ in range(2):
        run_ticks(graph, server, 0, 1_800_000, len(names))
        server.reset_time(0)
    notes = read_notes(file)
    back = [note["what"] for note in notes].index("back")
    flights = [[note for note in part if note["what"] == "ranges"] for part in (notes[:back], notes[back:])]
    assert flights[0] == flights[1]
    stamps = [note["stamp"] for note in flights[0]]
    assert stamps == [*range(0, 1_200_000, 125_000), 1_500_000, 1_625_000]  # 1.25 and 1.375 s: switched off
    assert {note["frame"] for note in flights[0]} == {f"{NAMES[0]}/uwb_frame"}
    by_time = {note["stamp"]: note["ranges"] for note in flights[0]}
    assert by_time[625_000] == by_time[750_000] == by_time[500_000]  # frozen
    assert by_time[1_125_000] == []  # its neighbour is switched off, and does not answer
    for stamp, ranges in by_time.items():
        if stamp in (625_000, 750_000, 1_125_000):
            continue
        ((vehicle, frame, distance, azimuth, elevation),) = ranges  # the third vehicle is out of range
        assert (vehicle, frame) == (NAMES[1], f"{NAMES[1]}/uwb_frame")
        x, y = 10.0 - SPEED * stamp * 1e-6, 10.0
        bias = 5.0 if stamp in (875_000, 1_000_000) else 0.0
        assert distance == pytest.approx(math.hypot(x, y) + bias, abs=0.4)  # noise of 0.1 m
        assert azimuth == pytest.approx(math.atan2(y, x), abs=0.2)  # of 0.05 rad
        assert elevation == pytest.approx(0.0, abs=0.2)
    words = [note["words"] for note in notes if note["what"] == "answer"]
    assert "failure: 'broken' is not allowed, ok, off, frozen, biased or dropouts" in words[0]
    assert words[2] == f"/{NAMES[0]}/uwb: biased 5"


def test_a_vehicle_that_joins_measures_and_is_measured_until_it_leaves(graph: Graph, server: LockstepServer) -> None:
    graph.set_param("/xtdrone/fleet", "iris_uwb_bearing:2")
    graph.set_param("/uwb/rate", RATE)
    file = graph.folder / "watcher.json"
    graph.start("uwb", sys.executable, str(NODE))
    graph.role(__file__, "inviter")
    graph.role(__file__, "watcher", str(file))
    names = ["/uwb", "/inviter", "/watcher"]
    wait_for_nodes(graph, server, names)
    for _ in range(2):
        run_ticks(graph, server, 0, 1_300_000, len(names))
        server.reset_time(0)
    run_ticks(graph, server, 0, 40_000, len(names))
    notes = read_notes(file)
    assert [note["back"] for note in notes if "back" in note] == [0, 0]  # the publisher is gone
    back = next(k for k, note in enumerate(notes) if "back" in note)
    alone, joined = (
        {(note["vehicle"], note["stamp"]): note["ranges"] for note in part if "vehicle" in note}
        for part in (notes[:back], notes[back:])
    )
    stamps = [375_000, 500_000, 625_000, 750_000, 875_000]
    guests = {key: ranges for key, ranges in joined.items() if key[0] == NAMES[2]}
    assert [stamp for _, stamp in guests] == stamps
    for ranges in guests.values():
        assert list(ranges) == list(NAMES[:2])
        assert ranges[NAMES[0]][0] == pytest.approx(7.0, abs=0.5)  # noise of 0.1 m
        assert ranges[NAMES[1]][0] == pytest.approx(math.hypot(10.0, 3.0), abs=0.5)
    measured = {key: ranges.pop(NAMES[2]) for key, ranges in joined.items() if NAMES[2] in ranges}
    assert sorted(measured) == sorted((name, stamp) for name in NAMES[:2] for stamp in stamps)
    assert {key: ranges for key, ranges in joined.items() if key not in guests} == alone  # to the last bit
    found = [ranges[0] for (name, _), ranges in measured.items() if name == NAMES[0]]
    assert found == pytest.approx([7.0] * len(stamps), abs=0.5)
    assert len(set(found)) == len(stamps)


def test_a_fleet_without_sensors_is_reported(graph: Graph) -> None:
    graph.set_param("/uwb/fleet", "iris:2")
    node = graph.start("uwb", sys.executable, str(NODE))
    assert node.wait(120.0) == 2
    assert "no vehicle of 'iris:2' has a UWB sensor" in graph.output()


def main() -> None:
    """Run a node."""
    {"teller": teller, "taker": taker, "inviter": inviter, "watcher": watcher}[sys.argv[1]](*sys.argv[2:])


if __name__ == "__main__":
    main()
