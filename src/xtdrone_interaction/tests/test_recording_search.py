"""A search read from its bag, complete or truncated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import Bag
from rosbags.typesys import get_types_from_msg

from xtdrone_interaction.missions.search.record import CUT_SHORT, read_search
from xtdrone_interaction.recording.recorded_flight import RecordError

MESSAGES = Path(__file__).parents[2] / "msgs"
OBJECTS = "xtdrone_msgs/msg/ObjectsOnGround"
NAMES = ("uav_0", "uav_1")
SECONDS = 10.0


class SearchBag(Bag):
    """Writes two vehicles that fly east, and a person that appears after 2 s and walks north."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, threshold=20_000)
        for package, name in (("darknet_ros_msgs", "BoundingBox"), ("xtdrone_msgs", "ObjectOnGround"),
                              ("xtdrone_msgs", "ObjectsOnGround")):  # fmt: skip
            text = (MESSAGES / package / "msg" / f"{name}.msg").read_text()
            self.store.register(get_types_from_msg(text, f"{package}/msg/{name}"))

    def zero(self, kind: str, **values: Any) -> Any:
        """Return a message with the given fields; all others are 0 or empty."""
        fields = dict(values)
        for name, (node, what) in self.store.fielddefs[kind][1]:
            if name not in fields and node == 2:
                fields[name] = self.zero(what)
            elif name not in fields and node == 1:
                fields[name] = "" if what[0] == "string" else 0
            elif name not in fields:
                fields[name] = np.zeros(what[1] if node == 3 else 0, np.float64)
        return self.store.types[kind](**fields)

    def truth(self, name: str, place: tuple[float, float, float], time: float) -> None:
        """Write the true pose of a model."""
        kind = "nav_msgs/msg/Odometry"
        pose = self.zero("geometry_msgs/msg/Pose", position=self.vector(*place, kind="Point"))
        with_covariance = self.zero("geometry_msgs/msg/PoseWithCovariance", pose=pose)
        message = self.zero(kind, header=self.header(time), pose=with_covariance)
        self.write(f"/xtdrone/{name}/ground_truth/odom", kind, message, time)

    def objects(self, name: str, probabilities: tuple[float, ...], time: float) -> None:
        """Write the tracks in an image, numbered from 1."""
        kind = "xtdrone_msgs/msg/ObjectOnGround"
        tracks = [self.zero(kind, id=i, probability=p, object_class="person") for i, p in enumerate(probabilities, 1)]
        message = self.zero(OBJECTS, header=self.header(time), vehicle=name, dropped=int(time), objects=tracks)
        self.write(f"/xtdrone/{name}/objects", OBJECTS, message, time)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with SearchBag(tmp_path / "flight.bag") as bag:
        bag.text("/xtdrone/search/event", json.dumps({"event": "started", "time": 0.0, "vehicles": NAMES}), 0.0)
        for time in np.arange(0.0, SECONDS, 0.1).tolist():
            for number, name in enumerate(NAMES):
                bag.truth(name, (time, 5.0 * number, 12.0), time)
            if time >= 2.0:
                bag.truth("person_0", (3.0, time, 0.0), time)
            bag.objects(NAMES[0], (0.9, 0.0), time)
            bag.text("/xtdrone/search/progress", json.dumps({"covered_fraction": time / SECONDS}), time)
        bag.text("/xtdrone/search/event", json.dumps({"event": "finished", "time": SECONDS, "outcome": "found"}), 9.95)
    return tmp_path / "flight.bag"


def test_tracks_sights_and_events_are_those_of_the_bag(path: Path) -> None:
    record = read_search(path, NAMES, ("person_0", "person_1"))
    np.testing.assert_allclose(record.position[:, 1], [[t, 5.0, 12.0] for t in record.time])
    person = record.persons["person_0"]
    assert np.isnan(person[record.time < 1.95]).all()
    np.testing.assert_allclose(person[record.time > 1.95], [[3.0, t, 0.0] for t in record.time if t > 1.95], atol=1e-9)
    assert np.isnan(record.persons["person_1"]).all()
    assert record.nearest_person((3.0, 5.0), 5.0) == ("person_0", pytest.approx(0.0))
    assert len(record.sights[NAMES[0]]) == 100
    sight = record.sights[NAMES[0]][50]
    assert (sight.time, sight.dropped, sight.ids, sight.seen) == (pytest.approx(5.0), 5, (1, 2), (1,))
    assert record.sights[NAMES[1]] == []
    assert record.finished["outcome"] == "found"


def test_a_search_that_is_cut_off_is_read_as_far_as_it_goes(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    record = read_search(path, NAMES, ("person_0",))
    assert 1.0 < record.time[-1] < 9.0
    assert record.finished["outcome"] == CUT_SHORT
    assert record.finished["covered_fraction"] == pytest.approx(record.time[-1] / SECONDS, abs=0.05)


def test_a_bag_without_true_positions_is_no_search(tmp_path: Path) -> None:
    with Bag(tmp_path / "flight.bag") as bag:
        bag.text("/words", "word", 0.0)
    with pytest.raises(RecordError, match="no true positions"):
        read_search(tmp_path / "flight.bag", NAMES, ())
