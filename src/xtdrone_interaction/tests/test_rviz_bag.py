"""A recorded flight as published to rviz: complete, and up to the end of a truncated bag."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rospy")

from bags import helix, make_flight

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.rviz.films.messages_from_bag import FlightBag

POSES = [f"/iris_{i}/mavros/local_position/pose" for i in range(2)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    make_flight(tmp_path / "flight.bag", ("/iris_0", "/iris_1"), 4.0)
    return tmp_path / "flight.bag"


def test_messages_are_read_in_the_order_of_their_stamps(path: Path) -> None:
    bag = FlightBag(path)
    assert (bag.fleet, bag.begin_us, bag.end_us) == ("iris:2", 500_000, 4_450_000)
    messages = list(bag.messages(POSES))
    assert [message.time_us for message in messages] == sorted(message.time_us for message in messages)
    assert len(messages) == 160
    last = messages[-1]
    x, y, z = helix(4.45, 10.0 * POSES.index(last.topic))
    place = last.message.pose.position
    assert (place.x, place.y, place.z) == pytest.approx((x, y, z))
    assert bag.flown is not None
    assert bag.flown[1, 0] == pytest.approx(max(message.message.pose.position.x for message in messages))


def test_a_bag_that_is_cut_off_is_shown_as_far_as_it_goes(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:30_000])
    bag = FlightBag(path)
    messages = list(bag.messages(POSES))
    assert 50 < len(messages) < 160
    assert bag.end_us == messages[-1].time_us


def test_files_other_than_bags_are_reported(tmp_path: Path) -> None:
    (tmp_path / "flight.bag").write_text("no bag")
    with pytest.raises(BagError, match=r"flight\.bag cannot be read"):
        FlightBag(tmp_path / "flight.bag")
