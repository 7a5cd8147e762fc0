"""Benchmark of the analysis: speed and memory of reading a large bag, and time of the whole report.

``python -m benchmarks.programs.analysis --megabytes 1000`` makes an uncompressed bag with the poses,
velocities and states of nine vehicles, reads it, and prints the figures.
"""

from __future__ import annotations

import argparse
import resource
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.programs.program_frame import Column, Row, run

_VEHICLES = 9
_STEP_NS = 20_000_000  # 50 Hz
_STEPS = 200  # in a chunk
_STATE = """std_msgs/Header header
bool connected
bool armed
bool guided
bool manual_input
string mode
uint8 system_status
"""


def _record(fields: dict[str, bytes], data: bytes) -> bytes:
    header = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in fields.items())
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def _messages() -> tuple[bytes, bytes, list[int]]:
    """Return the records of the connections, the message records of one step, and the offsets of times in these."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(_STATE, "mavros_msgs/msg/State"))
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    header = t["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="map")
    zero = t["geometry_msgs/msg/Vector3"](x=0.5, y=0.25, z=0.125)
    place = t["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0)
    rest = t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    pose = t["geometry_msgs/msg/Pose"](position=place, orientation=rest)
    twist = t["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    kinds = {
        "local_position/pose": t["geometry_msgs/msg/PoseStamped"](header=header, pose=pose),
        "local_position/velocity_local": t["geometry_msgs/msg/TwistStamped"](header=header, twist=twist),
        "state": t["mavros_msgs/msg/State"](
            header=header, connected=True, armed=True, guided=True, manual_input=False, mode="OFFBOARD", system_status=4
        ),
    }
    connections, step, times = b"", b"", []
    number = 0
    for vehicle in range(_VEHICLES):
        for name, message in kinds.items():
            kind = message.__msgtype__
            definition, md5 = store.generate_msgdef(kind)
            topic = f"/iris_{vehicle}/mavros/{name}".encode()
            connection = struct.pack("<I", number)
            more = {"topic": topic, "type": kind.replace("/msg/", "/").encode(), "md5sum": md5.encode(),
                    "message_definition": definition.encode()}  # fmt: skip
            inner = _record(more, b"")[4:-4]
            connections += _record({"conn": connection, "op": b"\x07", "topic": topic}, inner)
            raw = bytes(store.serialize_ros1(message, kind))
            record = _record({"conn": connection, "op": b"\x02", "time": bytes(8)}, raw)
            times += [len(step) + record.index(b"time=") + 5, len(step) + len(record) - len(raw) + 4]
            step += record
            number += 1
    return connections, step, times


def chunks(size: int) -> Iterator[bytes]:
    """Yield a bag of about ``size`` bytes: its header, then chunk after chunk."""
    connections, step, times = _messages()
    yield b"#ROSBAG V2.0\n" + _record({"op": b"\x03", "index_pos": bytes(8), "conn_count": bytes(4),
                                       "chunk_count": bytes(4)}, b" " * 4000)  # fmt: skip
    block = np.frombuffer(step * _STEPS, np.uint8).reshape(_STEPS, len(step)).copy()
    done, now = 0, 1_000_000_000
    while done < size:
        moments = now + _STEP_NS * np.arange(_STEPS, dtype=np.int64)
        stamps = np.stack([moments // 10**9, moments % 10**9], axis=1).astype("<u4").view(np.uint8)
        for at in times:
            block[:, at : at + 8] = stamps
        data = (connections if not done else b"") + block.tobytes()
        now += _STEP_NS * _STEPS
        fields = {"compression": b"none", "op": b"\x05", "size": struct.pack("<I", len(data))}
        chunk = _record(fields, data)
        done += len(chunk)
        yield chunk


def measure(megabytes: int, folder: Path) -> dict[str, Any]:
    """Make a bag, read it, and make its report.

    Args:
        megabytes: minimum size of the bag, MB.
        folder: of the bag, which is removed afterwards, and of the report.

    Returns:
        megabytes, messages, seconds (of reading, file in the page cache), megabytes_per_second, memory_bytes (peak of
        the process while reading), report_seconds (reading, figures, images and page).
    """
    from rich.console import Console

    from xtdrone_interaction.missions.formation.report import find_formation
    from xtdrone_interaction.recording.flight_from_bag import read_bag
    from xtdrone_interaction.report.analyse import analyse

    bag = folder / "made.bag"
    small = folder / "small.bag"
    try:
        small.write_bytes(b"".join(chunks(1)))
        with bag.open("wb") as file:
            for chunk in chunks(megabytes * 1_000_000):
                file.write(chunk)
        read_bag([small])  # compiles the kernels
        size = bag.stat().st_size
        began, worked = time.perf_counter(), time.process_time()
        flight = read_bag([bag])
        seconds, cpu = time.perf_counter() - began, time.process_time() - worked
        memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        began = time.perf_counter()
        analyse([bag], folder, Console(file=sys.stderr), find=find_formation)
        report = time.perf_counter() - began
    finally:
        bag.unlink(missing_ok=True)
        small.unlink(missing_ok=True)
    return {
        "megabytes": megabytes,
        "messages": sum(topic.count for topic in flight.topics),
        "seconds": seconds,
        "cpu_seconds": cpu,
        "megabytes_per_second": size / 1e6 / seconds,
        "memory_bytes": memory,
        "report_seconds": report,
    }


COLUMNS = (
    Column("MB", "{megabytes}"),
    Column("reading MB/s", "{megabytes_per_second:.0f}"),
    Column("CPU s", "{cpu_seconds:.2f}"),
    Column("messages", "{messages}"),
    Column("memory bytes", "{memory_bytes}"),
    Column("report s", "{report_seconds:.1f}"),
)


def main() -> int:
    """Measure the bag size of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megabytes", type=int, default=1000, help="size of the bag, MB")
    parser.add_argument("--folder", type=Path, help="where the bag is made and removed again (default: beside --json)")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    folder = arguments.folder or (arguments.json.parent if arguments.json else Path())
    yield measure(arguments.megabytes, folder)


if __name__ == "__main__":
    sys.exit(main())
