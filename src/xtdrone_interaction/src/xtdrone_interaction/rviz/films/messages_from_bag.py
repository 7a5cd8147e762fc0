"""A recorded flight, also a cut off one, as a source of ROS messages in simulated time."""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import roslib.message

from xtdrone_common.fleet import FleetError, Vehicle, parse_fleet
from xtdrone_interaction.bags.bag_kinds import large_batches
from xtdrone_interaction.bags.ros1bag import BagError, BagFile
from xtdrone_lockstep.ros_codec import compile_class

_POSE = re.compile(r"/(?P<type>\w+)_(?P<index>\d+)/mavros/local_position/pose")


class Timed(NamedTuple):
    """A message of a bag.

    Attributes:
        time_us: simulated time of its publication, microseconds.
        topic: name.
        message: decoded by this workspace's type.
    """

    time_us: int
    topic: str
    message: Any


class FlightBag:
    """A bag with the poses of vehicles.

    The recorder's times may be wrong by seconds, so the time of a message is its own stamp or, without one, the latest
    stamp of the poses recorded before it.

    Attributes:
        fleet: such as ``iris:9``.
        vehicles: of the fleet.
        types: message type by topic.
        begin_us, end_us: simulated times of the first and the last pose, microseconds.
        flown: lowest and highest coordinates of all poses, shape (2, 3), m; None without finite poses.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            BagError: it cannot be read, or lacks poses.
        """
        if not path.is_file():
            raise BagError(f"bag: {path} does not exist")
        self._path = path
        try:
            self._bag = BagFile(path)
            for _ in self._bag.batches():  # collects the connections
                pass
        except BagError as error:
            raise BagError(f"bag: {path} cannot be read ({error})") from error
        connections = self._bag.connections.values()
        self.types = {connection.topic: connection.type for connection in connections}
        self._md5sums = {connection.topic: connection.md5 for connection in connections}
        self._poses = {topic: match for topic in self.types if (match := _POSE.fullmatch(topic))}
        self.fleet = self._fleet()
        self.vehicles: tuple[Vehicle, ...] = parse_fleet(self.fleet)
        poses = list(self._raw({topic: self._message_class(topic) for topic in self._poses}))
        times = [time_us for time_us, *_ in poses]
        self.begin_us, self.end_us = min(times), max(times)
        places = np.array([_position(data) for *_, data in poses])
        places = places[np.isfinite(places).all(axis=1)]
        self.flown = np.stack([places.min(axis=0), places.max(axis=0)]) if len(places) else None

    def _fleet(self) -> str:
        counts: dict[str, int] = {}
        for found in self._poses.values():
            counts[found["type"]] = max(counts.get(found["type"], 0), int(found["index"]) + 1)
        text = ",".join(f"{kind}:{count}" for kind, count in sorted(counts.items()))
        try:
            vehicles = parse_fleet(text) if text else ()
        except FleetError as error:
            raise BagError(f"bag: {self._path}: {error}") from error
        if not vehicles or len(vehicles) != len(self._poses):
            raise BagError(
                f"bag: {self._path} has no /VEHICLE_<i>/mavros/local_position/pose of each vehicle from 0 on"
            )
        return text

    def messages(self, topics: Collection[str]) -> Iterator[Timed]:
        """Yield the messages of ``topics`` in order of time.

        Raises:
            BagError: the type of a message differs from this workspace's type of that name.
        """
        classes = {topic: self._message_class(topic) for topic in topics if topic in self.types}
        for time_us, _, topic, data in sorted(self._raw(classes)):
            yield Timed(time_us, topic, classes[topic]().deserialize(data))

    def _message_class(self, topic: str) -> Any:
        kind = self.types[topic]
        cls = roslib.message.get_message_class(kind)
        if cls is None or cls._md5sum != self._md5sums[topic]:
            raise BagError(f"bag: {self._path}: {topic} has another {kind} than this workspace")
        compile_class(cls)
        return cls

    def _raw(self, classes: Mapping[str, Any]) -> Iterator[tuple[int, int, str, bytes]]:
        """Yield time (us), number, topic and content of all messages after the first pose, in recorded order."""
        newest_us = -1
        for number, (topic, data) in enumerate(self._serialised({*classes, *self._poses})):
            own_us = -1
            if topic in self._poses or classes[topic]._has_header:
                _, seconds, nanoseconds = struct.unpack_from("<III", data)  # the header is a message's first field
                own_us = seconds * 1_000_000 + nanoseconds // 1000
            if topic in self._poses:
                newest_us = max(newest_us, own_us)
            if topic in classes and newest_us >= 0:
                yield own_us if own_us > 0 else newest_us, number, topic, data

    def _serialised(self, topics: Collection[str]) -> Iterator[tuple[str, bytes]]:
        """Yield topic and content of the messages of ``topics``, in the order of the recorder's times."""
        numbers = {number: c.topic for number, c in self._bag.connections.items() if c.topic in topics}
        for batch in large_batches(self._bag):
            rows = np.flatnonzero(np.isin(batch.connection, list(numbers)))
            for row in rows[np.argsort(batch.time[rows], kind="stable")].tolist():
                start = int(batch.offset[row])
                yield numbers[int(batch.connection[row])], batch.data[start : start + int(batch.length[row])].tobytes()


def _position(data: bytes) -> tuple[float, float, float]:
    """Return the position in a serialised PoseStamped, m, which follows the stamp and the name of the frame."""
    (letters,) = struct.unpack_from("<I", data, 12)
    return struct.unpack_from("<ddd", data, 16 + letters)
