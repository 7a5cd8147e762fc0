"""A synthetic formation flight, written as a bag: first-order motion, no ROS, no simulator."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

STEP = 0.032  # s, a multiple of the simulator's base step
RATE = 0.8  # 1/s, the first-order motion's gain
GRID = np.array([[3.0 * (i % 3), 3.0 * (i // 3), 0.0] for i in range(1, 9)])
CUBE = np.array([[x, y, z] for z in (2.0, -2.0) for x, y in ((2, 2), (-2, 2), (-2, -2), (2, -2))])
PYRAMID = np.array([[s * x, s * y, -2.0 * s] for s in (1, 2) for x, y in ((2, 2), (-2, 2), (-2, -2), (2, -2))])
TRIANGLE = np.array(
    [[0, 4, -4], [0, 0, -2], [0, 0, -4], [0, -2, -2], [0, 2, -4], [0, 2, -2], [0, -4, -4], [0, -2, -4]], dtype=float
)
SLOTS = {"origin": GRID, "cube": CUBE, "pyramid": PYRAMID, "triangle": TRIANGLE}
NAMES = [f"iris_{i}" for i in range(9)]
WINDOW = 12.0  # s for each pattern

_MODEL_STATES = """
string[] name
geometry_msgs/Pose[] pose
geometry_msgs/Twist[] twist
"""


def assign(before: NDArray[np.float64], slots: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``slots`` in the followers' order with the least total distance."""
    return slots[linear_sum_assignment(cdist(before, slots))[1]]


class BagMaker:
    """Writes the topics of a flight record."""

    def __init__(self, writer: Writer, truth: bool, odometry: bool = False) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC)
        self.store.register(get_types_from_msg(_MODEL_STATES, "gazebo_msgs/msg/ModelStates"))
        self.writer = writer
        self.truth = truth
        self.odometry = odometry
        self.connections: dict[str, object] = {}
        self.events: list[dict[str, object]] = []
        self.delay = 0.0
        self.clock = 0.0

    def write(self, topic: str, kind: str, message: object, time: float) -> None:
        """Write one message at ``time`` s, recorded ``delay`` s late, as by a wrong clock of the recorder."""
        time = self.clock = max(self.clock, time + self.delay)
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        self.writer.write(self.connections[topic], round(time * 1e9), self.store.serialize_ros1(message, kind))

    def event(self, time: float, event: str, **values: object) -> None:
        """Write one of the director's events; the wall clock runs at half the rate of simulated time."""
        values = {"event": event, "time": time, "wall": 1000.0 + time / 2, **values}
        self.events.append(values)
        string = self.store.types["std_msgs/msg/String"]
        self.write("/xtdrone/demo/events", "std_msgs/msg/String", string(data=json.dumps(values)), time)

    def log(self, time: float, text: str) -> None:
        """Write a warning of the simulator node."""
        t = self.store.types
        stamp = t["builtin_interfaces/msg/Time"](sec=int(time), nanosec=0)
        header = t["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="")
        kind = "rosgraph_msgs/msg/Log"
        message = t[kind](
            header=header, level=4, name="/simulator", msg=text, file="", function="", line=0, topics=[]
        )  # fmt: skip
        self.write("/rosout", kind, message, time)

    def positions(self, time: float, places: NDArray[np.float64]) -> None:
        """Write positions of the vehicles, shape (n, 3)."""
        t = self.store.types
        rest = t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        poses = [
            t["geometry_msgs/msg/Pose"](position=t["geometry_msgs/msg/Point"](*map(float, p)), orientation=rest)
            for p in places
        ]
        if self.truth:
            zero = t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
            twists = [t["geometry_msgs/msg/Twist"](linear=zero, angular=zero)] * (len(NAMES) + 1)
            kind = "gazebo_msgs/msg/ModelStates"
            message = t[kind](name=["ground_plane", *NAMES], pose=[poses[0], *poses], twist=twists)
            self.write("/gazebo/model_states", kind, message, time)
        nanoseconds = round(time * 1e9)
        stamp = t["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        header = t["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="map")
        kind = "geometry_msgs/msg/PoseStamped"
        for name, pose in zip(NAMES, poses, strict=True):
            self.write(f"/{name}/mavros/local_position/pose", kind, t[kind](header=header, pose=pose), time)
            if self.odometry:
                self.write_odometry(name, header, pose, time)

    def write_odometry(self, name: str, header: object, pose: object, time: float) -> None:
        """Write a vehicle's true odometry with its time."""
        t = self.store.types
        zero = t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        unknown = np.zeros(36)
        kind = "nav_msgs/msg/Odometry"
        message = t[kind](
            header=header,
            child_frame_id=f"{name}/base_link",
            pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=unknown),
            twist=t["geometry_msgs/msg/TwistWithCovariance"](
                twist=t["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=unknown
            ),
        )
        self.write(f"/xtdrone/{name}/ground_truth/odom", kind, message, time)

    def formation(self, time: float, offsets: NDArray[np.float64]) -> None:
        """Write the assigned offsets, shape (8, 3), and a topology: each vehicle listens to its predecessor.

        Without offsets, shape (0, 3), both are empty: the leader withdraws them.
        """
        t = self.store.types
        layout = t["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        kind = "std_msgs/msg/Float32MultiArray"
        message = t[kind](layout=layout, data=offsets.T.ravel().astype(np.float32))
        self.write("/xtdrone/formation_pattern", kind, message, time)
        kind = "std_msgs/msg/Int32MultiArray"
        message = t[kind](layout=layout, data=np.eye(9 if len(offsets) else 0, k=-1, dtype=np.int32).ravel())
        self.write("/xtdrone/communication_topology", kind, message, time)


PATTERNS = ("origin", "cube", "pyramid", "triangle")


def make_bag(
    path: Path,
    patterns: tuple[str, ...] = PATTERNS,
    truth: bool = True,
    odometry: bool = False,
    noise: float = 0.01,
    offset: float = 0.0,
    shuffle: bool = False,
    delay: float = 0.0,
    log: tuple[str, ...] = (),
    taken_back: bool = False,
) -> list[dict[str, object]]:
    """Write a flight and return its events. Each pattern's window is WINDOW long; followers move with gain RATE.

    Args:
        path: of the bag.
        patterns: flown in turn.
        truth: whether /gazebo/model_states is recorded.
        odometry: whether the vehicles' ground_truth/odom is recorded.
        noise: standard deviation of all positions, m.
        offset: distance of follower 3 from its slot along x, m.
        delay: error of the recorder's clock, s: late in one part of each pattern, early in another.
        log: a warning of the simulator during the flight.
        taken_back: whether the leader withdraws the last pattern.
        shuffle: assign the slots in reverse order instead of at the least distance.
    """
    rng = np.random.default_rng(0)
    with Writer(path) as writer:
        maker = BagMaker(writer, truth, odometry)
        places = np.vstack([np.zeros(3), GRID])
        offsets, time = GRID, 1.0
        maker.event(time, "start", vehicles=NAMES)
        maker.event(time, "phase", phase="takeoff")
        for _ in range(round(4.0 / STEP)):
            time += STEP
            places = places + np.array([0.0, 0.0, 7.0 * STEP / 4.0])
            maker.positions(time, places)
        maker.event(time, "armed", vehicle="iris_0")
        for text in log:
            maker.log(time, text)
        for pattern in patterns:
            maker.event(time, "phase", phase=f"pattern {pattern}", pattern=pattern)
            offsets = SLOTS[pattern][::-1] if shuffle else assign(offsets, SLOTS[pattern])
            maker.event(time, "assigned", pattern=pattern, offsets=offsets.tolist())
            goal = offsets.copy()
            goal[2, 0] += offset
            for tick in range(round(WINDOW / STEP)):
                time += STEP
                maker.delay = delay * (0.3 < tick * STEP / WINDOW < 0.45) - delay * (tick * STEP / WINDOW > 0.9)
                maker.formation(time, offsets)
                places[1:] += RATE * STEP * (places[0] + goal - places[1:])
                maker.positions(time, places + noise * rng.standard_normal(places.shape))
        maker.delay = 0.0
        if taken_back:
            maker.formation(time, np.empty((0, 3)))
        maker.event(time, "phase", phase="land")
        maker.event(time, "done")
    return maker.events
