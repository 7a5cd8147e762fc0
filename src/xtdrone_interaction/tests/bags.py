"""Synthetic bags of known motions, written by rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

RADIUS, TURN, CLIMB = 5.0, 0.5, 0.2  # m, rad/s, m/s
POSE, TWIST, STATE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped", "mavros_msgs/msg/State"
_STATE = "std_msgs/Header header\nbool connected\nbool armed\nbool guided\n{more}string mode\nuint8 system_status\n"


def store(more: str = "bool manual_input\n") -> Any:
    """Return a type store of ROS 1 and of MAVROS's State, with or without a field that old versions lack."""
    made = get_typestore(Stores.ROS1_NOETIC)
    made.register(get_types_from_msg(_STATE.format(more=more), STATE))
    return made


class Bag:
    """Writes messages; ``start`` is added to all times, s."""

    def __init__(
        self, path: Path, packing: str = "", threshold: int = 1 << 20, start: float = 0.0, **more: Any
    ) -> None:
        self.writer = Writer(path)
        if packing:
            self.writer.set_compression(Writer.CompressionFormat[packing.upper()])
        self.writer.chunk_threshold = threshold
        self.start = start
        self.store = store(**more)
        self.connections: dict[tuple[str, str], Any] = {}
        self.seq = 0

    def __enter__(self) -> Bag:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def type(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, time: float, frame: str = "map") -> Any:
        self.seq += 1
        nanoseconds = round((self.start + time) * 1e9)
        stamp = self.type("builtin_interfaces/msg/Time")(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.type("std_msgs/msg/Header")(seq=self.seq, stamp=stamp, frame_id=frame)

    def write(self, topic: str, kind: str, message: Any, time: float) -> None:
        if (topic, kind) not in self.connections:
            self.connections[topic, kind] = self.writer.add_connection(topic, kind, typestore=self.store)
        raw = self.store.serialize_ros1(message, kind)
        self.writer.write(self.connections[topic, kind], round((self.start + time) * 1e9), raw)

    def text(self, topic: str, text: str, time: float) -> None:
        kind = "std_msgs/msg/String"
        self.write(topic, kind, self.type(kind)(data=text), time)

    def vector(self, x: float, y: float, z: float, kind: str = "Vector3") -> Any:
        return self.type(f"geometry_msgs/msg/{kind}")(x=float(x), y=float(y), z=float(z))

    def pose(self, space: str, place: Any, time: float) -> None:
        rest = self.type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0)
        pose = self.type("geometry_msgs/msg/Pose")(position=self.vector(*place, kind="Point"), orientation=rest)
        self.write(
            f"{space}/mavros/local_position/pose", POSE, self.type(POSE)(header=self.header(time), pose=pose), time
        )

    def velocity(self, space: str, velocity: Any, time: float) -> None:
        twist = self.type("geometry_msgs/msg/Twist")(linear=self.vector(*velocity), angular=self.vector(0, 0, 0))
        message = self.type(TWIST)(header=self.header(time), twist=twist)
        self.write(f"{space}/mavros/local_position/velocity_local", TWIST, message, time)

    def state(self, space: str, mode: str, armed: bool, time: float, **more: Any) -> None:
        message = self.type(STATE)(
            header=self.header(time, ""), connected=True, armed=armed, guided=True, mode=mode, system_status=4, **more
        )
        self.write(f"{space}/mavros/state", STATE, message, time)


def helix(time: Any, centre: float = 0.0) -> np.ndarray:
    """Return positions on a climbing circle, shape (..., 3)."""
    angle = TURN * np.asarray(time)
    return np.stack([centre + RADIUS * np.cos(angle), RADIUS * np.sin(angle), CLIMB * np.asarray(time)], axis=-1)


def make_flight(path: Path, spaces: tuple[str, ...], seconds: float, rate: float = 20.0, **options: Any) -> None:
    """Write vehicles on the same helix, each 10 m east of the one before; armed from 1 s, OFFBOARD from 2 s on."""
    more = {} if options.get("more") == "" else {"manual_input": True}
    with Bag(path, **options) as bag:
        for k in range(round(seconds * rate)):
            time = 0.5 + k / rate
            for number, space in enumerate(spaces):
                bag.pose(space, helix(time, 10.0 * number), time)
                angle = TURN * time
                bag.velocity(space, (-RADIUS * TURN * np.sin(angle), RADIUS * TURN * np.cos(angle), CLIMB), time)
                if k % 10 == 0:
                    bag.state(space, "OFFBOARD" if time >= 2.0 else "AUTO.LOITER", time >= 1.0, time, **more)
