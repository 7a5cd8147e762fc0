"""Processor time of ROS messages' codecs: ``python -m benchmarks.programs.codecs --message PositionTarget``.

The program prints the time of encoding and decoding a message, with the compiled codec and with genpy's Python code.
Decoding includes the construction of the message.
"""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import genpy
from gazebo_msgs.msg import ModelStates
from genpy.dynamic import generate_dynamic
from geometry_msgs.msg import Pose, PoseStamped, TransformStamped, Twist, TwistStamped
from mavros_msgs.msg import AttitudeTarget, PositionTarget, State
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray, String
from tf2_msgs.msg import TFMessage

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_lockstep.ros_codec import compile_class

_BATCH = 200
_METHODS = ("encode", "decode", "genpy_encode", "genpy_decode")

MESSAGES: dict[str, Callable[[int], Any]] = {
    "PositionTarget": lambda _: PositionTarget(),
    "AttitudeTarget": lambda _: AttitudeTarget(),
    "PoseStamped": lambda _: PoseStamped(),
    "TwistStamped": lambda _: TwistStamped(),
    "Imu": lambda _: Imu(),
    "Odometry": lambda _: Odometry(),
    "State": lambda _: State(mode="OFFBOARD"),
    "Clock": lambda _: Clock(),
    "String": lambda _: String("hover"),
    "Float64MultiArray": lambda vehicles: Float64MultiArray(data=[0.1 * i for i in range(6 * vehicles)]),
    "TFMessage": lambda vehicles: TFMessage([TransformStamped() for _ in range(vehicles)]),
    "ModelStates": lambda vehicles: ModelStates(
        [f"iris_{i}" for i in range(vehicles)], [Pose() for _ in range(vehicles)], [Twist() for _ in range(vehicles)]
    ),
}
"""Makes a message of a number of vehicles."""


def _methods(message: Any) -> tuple[Callable[[], Any], ...]:
    codec = compile_class(type(message))
    assert codec is not None
    data = codec.encode(message)
    assert data is not None
    # A class made at run time, which keeps genpy's methods, as do those of its fields.
    plain: Any = generate_dynamic(message._type, message._full_text)[message._type]
    same = plain().deserialize(data)
    return (
        lambda: codec.encode(message),
        lambda: codec.decode(data),
        lambda: same.serialize(io.BytesIO()),
        lambda: plain().deserialize(data),
    )


def measure(name: str, vehicles: int, seconds: float) -> Row:
    """Measure one message, the four methods in turn.

    Args:
        name: of the message, a key of ``MESSAGES``.
        vehicles: in a message about many, at least 1.
        seconds: minimum processor time of the measurement, above 0.

    Returns:
        message, vehicles, bytes; encode, decode, genpy_encode, genpy_decode: us of processor time, the lowest of
        batches.
    """
    message = MESSAGES[name](vehicles)
    if hasattr(message, "header"):
        message.header.frame_id, message.header.stamp = "map", genpy.Time(100, 4_000_000)
    methods = _methods(message)
    lowest = [float("inf")] * len(methods)
    end = time.process_time() + seconds
    while time.process_time() < end:
        for number, method in enumerate(methods):
            began = time.process_time()
            for _ in range(_BATCH):
                method()
            lowest[number] = min(lowest[number], (time.process_time() - began) / _BATCH)
    figures = {method: 1e6 * value for method, value in zip(_METHODS, lowest, strict=True)}
    return {"message": name, "vehicles": vehicles, "bytes": len(methods[0]()), **figures}


COLUMNS = (
    Column("message".rjust(18), "{message}"),
    Column("bytes", "{bytes}"),
    Column("encode us", "{encode:.2f}"),
    Column("genpy us", "{genpy_encode:.2f}"),
    Column("decode us", "{decode:.2f}"),
    Column("genpy us", "{genpy_decode:.2f}"),
)


def main() -> int:
    """Measure the messages of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--message", choices=MESSAGES, help="measure this message only")
    parser.add_argument("--vehicles", type=int, default=9, help="in a message about many")
    parser.add_argument("--seconds", type=float, default=1.0, help="minimum processor time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    if arguments.vehicles < 1 or not arguments.seconds > 0.0:
        raise ValueError("vehicles: at least 1; seconds: above 0")
    for name in [arguments.message] if arguments.message else MESSAGES:
        yield measure(name, arguments.vehicles, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
