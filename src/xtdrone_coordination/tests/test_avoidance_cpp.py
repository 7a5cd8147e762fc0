"""The avoidance in C++ equals the one in Python to the last bit: the function, and the node in a graph.

Run as a program, this file is a node that publishes a swarm and records the avoidance published for it.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import os
import shutil
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from ros_graph import PATIENCE, Graph

import xtdrone_lockstep as lockstep
from xtdrone_coordination.laws.formation_avoidance import RADIUS, avoid
from xtdrone_lockstep.server import LockstepServer

try:
    import rospy
    from geometry_msgs.msg import PoseStamped, Vector3
    from std_msgs.msg import Float64MultiArray
except ImportError:
    rospy = None

PREFIXES = [prefix for prefix in os.environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep) if prefix]
LIBRARY = next(filter(Path.exists, (Path(prefix) / "lib/libavoidance_for_test.so" for prefix in PREFIXES)), None)
PROGRAMS = {
    name: shutil.which(name, path=os.pathsep.join(f"{prefix}/lib/xtdrone_coordination" for prefix in PREFIXES))
    for name in ("avoid.py", "avoid_cpp")
}
COUNT = 30

needs_library = pytest.mark.skipif(LIBRARY is None, reason="needs the built workspace (avoidance_for_test)")
needs_ros = pytest.mark.skipif(
    rospy is None or None in PROGRAMS.values(),
    reason="needs ROS 1 (rosmaster, rospy) and the built workspace (avoid_cpp)",
)


# ---- the function ----


def swarms() -> Iterator[tuple[str, np.ndarray, float, float]]:
    """Yield a name, positions (N, 3) with NaN for unknown, radius and gain."""
    rng = np.random.default_rng(11)
    for count, size in itertools.product((2, 9, 25, 60, 200), (1.0, 4.0, 30.0)):
        yield f"{count} within {size} m", rng.uniform(-size, size, (count, 3)), RADIUS, 1.0
    unknown = rng.uniform(-3.0, 3.0, (60, 3))
    unknown[rng.random(60) < 0.3] = math.nan
    yield "some unknown", unknown, RADIUS, 0.7
    lattice = np.array(list(itertools.product(range(-3, 4), repeat=3)), dtype=float)
    yield "a lattice as wide as the radius", RADIUS * lattice, RADIUS, 1.0
    yield "a lattice of tenths", 0.1 * lattice, 0.3, 1.0
    near = np.nextafter(RADIUS, 0.0)
    yield "just within the radius", np.array([[near * i, 0.0, -near * i] for i in range(40)]), 2.0 * near, 1.0
    pairs = rng.uniform(-5.0, 5.0, (20, 3))
    yield "all twice at one place", np.concatenate([pairs, pairs]), RADIUS, 1.0
    yield "almost at one place", np.concatenate([pairs, pairs + 3e-7]), RADIUS, 1.0
    yield "far away", 1e7 + rng.uniform(-2.0, 2.0, (40, 3)), RADIUS, 1.0
    yield "in a corner of the grid", 1.5e6 + rng.uniform(-2.0, 2.0, (40, 3)), RADIUS, 1.0
    yield "in space", rng.uniform(-1.0, 1.0, (40, 3)) * 1e300, RADIUS, 1.0
    yield "large radius", rng.uniform(-100.0, 100.0, (40, 3)), 1e6, 1.0
    yield "least radius", rng.uniform(-1e-200, 1e-200, (40, 3)), 5e-324, 1.0


@needs_library
@pytest.mark.parametrize(("positions", "radius", "gain"), [pytest.param(*rest, id=name) for name, *rest in swarms()])
def test_equals_the_python_function_to_the_last_bit(positions: np.ndarray, radius: float, gain: float) -> None:
    library = ctypes.CDLL(str(LIBRARY))
    places = np.ascontiguousarray(positions)
    result = np.full_like(places, math.nan)
    real = ctypes.POINTER(ctypes.c_double)
    library.avoidAll(
        places.ctypes.data_as(real),
        ctypes.c_size_t(len(places)),
        ctypes.c_double(radius),
        ctypes.c_double(gain),
        result.ctypes.data_as(real),
    )
    known = [None if math.isnan(place[0]) else tuple(place) for place in places.tolist()]
    expected = np.array([avoid(i, known, radius, gain) for i in range(len(known))])
    assert result.tobytes() == expected.tobytes()


# ---- the node ----


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    graph = Graph(tmp_path)
    yield graph
    graph.stop()


def swarm_maker(topic: str, out: str) -> None:
    """Publish a moving swarm, partly unknown, and record the avoidance that is published for it."""
    lockstep.init_node("swarm", rate=50.0)
    rng = np.random.default_rng(3)
    state = rng.uniform(-4.0, 4.0, (COUNT, 6))
    together = lockstep.Publisher(topic, Float64MultiArray) if topic else None
    poses = [lockstep.Publisher(f"/iris_{i}/mavros/local_position/pose", PoseStamped) for i in range(COUNT)]
    with open(out, "w", buffering=1) as file:

        def take(index: int, message: Vector3) -> None:
            now = rospy.Time.now().to_nsec() // 1000
            print(now, index, message.x.hex(), message.y.hex(), message.z.hex(), file=file)

        _keep = [lockstep.Subscriber(f"/xtdrone/iris_{i}/avoid_vel", Vector3, partial(take, i)) for i in range(COUNT)]
        lockstep.start()

        def step() -> None:
            state[:, :3] += rng.uniform(-0.1, 0.1, (COUNT, 3))
            shown = state.copy()
            shown[rng.random(COUNT) < 0.1] = math.nan
            if together is not None:
                together.publish(Float64MultiArray(data=shown.ravel().tolist()))
                return
            for place, publisher in zip(shown.tolist(), poses, strict=True):
                message = PoseStamped()
                p = message.pose.position
                p.x, p.y, p.z = place[:3]
                publisher.publish(message)

        lockstep.spin(step)


def heard(graph: Graph, program: str, topic: str, ids: str) -> list[str]:
    """Run a swarm with an avoidance node, set time back, run on, and return the published avoidance."""
    out = graph.folder / f"{program}.transcript"
    graph.master.setParam("/test", "/xtdrone/swarm_topic", topic)
    server = LockstepServer()
    try:
        graph.master.setParam("/test", "/lockstep/uri", server.uri)
        node = graph.start(str(PROGRAMS[program]), "iris", str(COUNT), "vel", f"_ids:={ids}", "_avoid_radius:=2")
        maker = graph.start(sys.executable, __file__, topic, str(out))
        names = ["/avoid", "/swarm"]
        assert server.wait_for(names, timeout=PATIENCE), server.missing(names)
        for end in (400_000, 200_000):
            server.reset_time(0)
            now: int | None = 0
            while now is not None and now < end:
                server.tick(now)
                now = server.next_due_us(now)
        assert sorted(server.participants) == names
    finally:
        server.close()
    assert node.wait(PATIENCE) == 0
    assert maker.wait(PATIENCE) == 0
    return out.read_text().splitlines()


@needs_ros
@pytest.mark.parametrize(("topic", "ids"), [("/xtdrone/swarm", "all"), ("", "0-4,7")])
def test_publishes_what_the_python_node_publishes(graph: Graph, topic: str, ids: str) -> None:
    python = heard(graph, "avoid.py", topic, ids)
    assert len(python) > 5 * 12
    # at 0 no position is known, also after a reset: the first avoidance is published at 36 ms
    times = [int(line.split()[0]) for line in python]
    assert min(times) == 40_000
    assert times.index(40_000, times.index(380_000)) > 0
    assert any(float.fromhex(line.split()[2]) != 0.0 for line in python)
    assert heard(graph, "avoid_cpp", topic, ids) == python


@needs_ros
def test_rejects_wrong_arguments_as_the_python_node(graph: Graph) -> None:
    """Only the messages differ: the Python node also checks the type and the fleet, which the C++ example omits."""

    def both(arguments: list[str]) -> None:
        python, cpp = (graph.run(str(PROGRAMS[name]), *arguments) for name in ("avoid.py", "avoid_cpp"))
        assert cpp.returncode == python.returncode == 2, (arguments, cpp.stderr, python.stderr)
        assert cpp.stderr.splitlines()[1].replace("avoid_cpp", "avoid.py") == python.stderr.splitlines()[1]

    both(["iris", "9"])
    both(["iris", "many", "vel"])
    both(["iris", "1", "vel"])
    both(["iris", "251", "vel"])
    both(["iris", "9", "speed"])
    for name, value in [("ids", "3-12"), ("ids", "1,,2"), ("ids", 9), ("avoid_radius", 0), ("avoid_radius", "wide")]:
        graph.master.setParam("/test", f"/avoid/{name}", value)
        both(["iris", "9", "vel"])
        graph.master.deleteParam("/test", f"/avoid/{name}")


@needs_ros
def test_a_missing_master_is_reported(graph: Graph) -> None:
    graph.ros_master.close()
    done = graph.run(str(PROGRAMS["avoid_cpp"]), "iris", "9", "vel")
    assert done.returncode == 1
    assert f"no ROS master at {graph.env['ROS_MASTER_URI']}" in done.stderr


if __name__ == "__main__":
    swarm_maker(*sys.argv[1:])
