"""The mission protocol: transfers, rejections and timeouts as in PX4."""

from __future__ import annotations

import math
import random
from itertools import count

import pytest
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.navigator import plan

NAN = math.nan
LATITUDE, LONGITUDE = 473977420, 85455940  # 1e-7 degrees


@pytest.fixture
def served():
    return Served()


def item(seq, command=16, frame=6, kind=0, current=0, params=(0.0, 0.0, 0.0, 0.0), z=10.0, x=None, y=None):
    x = LATITUDE + 100 * seq if x is None else x
    y = LONGITUDE if y is None else y
    return mavlink.MAVLink_mission_item_int_message(SYSTEM, 1, seq, frame, command, current, 1, *params, x, y, z, kind)


def float_item(seq, command=16, frame=3, kind=0):
    return mavlink.MAVLink_mission_item_message(
        SYSTEM, 1, seq, frame, command, 0, 1, 0.0, 0.0, 0.0, 0.0, 47.397742, 8.545594, 10.0, kind
    )


def number(items, kind=0):
    return mavlink.MAVLink_mission_count_message(SYSTEM, 1, items, kind)


def ack(result=0, kind=0):
    return mavlink.MAVLink_mission_ack_message(SYSTEM, 1, result, kind)


def kind_of(message):
    return type(message).__name__.removeprefix("MAVLink_").removesuffix("_message").upper()


def names(messages):
    return [kind_of(m) for m in messages]


def texts(served):
    found = [text.rstrip("\t") for _, text in served.commander.texts]
    served.commander.texts.clear()
    return found


def run(served, seconds):
    """Advance time; return the messages that the services send, events excluded."""
    return [entry for entry in served.run(seconds) if entry[1] not in ("EVENT", "CURRENT_EVENT_SEQUENCE")]


def upload(served, items, kind=0, link=None):
    """Send a list and return the type of the acknowledgement."""
    answers = served.ask(number(len(items), kind), link)
    for _ in items:
        if kind_of(answers[0]) == "MISSION_ACK":
            break
        answers = served.ask(items[answers[0].seq], link)
    return answers[0].type


def download(served, kind=0):
    (total,) = served.ask(mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, kind))
    found = [
        served.ask(mavlink.MAVLink_mission_request_int_message(SYSTEM, 1, seq, kind))[0] for seq in range(total.count)
    ]
    served.ask(ack(kind=kind))
    return found


# upload


def test_the_first_request_is_the_old_one_then_that_of_integers(served):
    (first,) = served.ask(number(3))
    assert (kind_of(first), first.seq) == ("MISSION_REQUEST", 0)
    assert (first.target_system, first.target_component) == (255, 190)
    (second,) = served.ask(item(0))
    assert (kind_of(second), second.seq) == ("MISSION_REQUEST_INT", 1)
    served.ask(item(1))
    (done,) = served.ask(item(2))
    assert (kind_of(done), done.type, done.mission_type) == ("MISSION_ACK", 0, 0)
    assert len(served.commander.navigator.plans.mission) == 3


def test_float_items_are_accepted(served):
    served.ask(number(2))
    (second,) = served.ask(float_item(0))
    assert kind_of(second) == "MISSION_REQUEST"
    assert served.ask(float_item(1))[0].type == 0
    stored = served.commander.navigator.plans.mission[1]
    assert (stored.x, stored.y) == pytest.approx((47.397742, 8.545594), abs=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"z": NAN},
        {"x": 2_000_000_000},
        {"x": 0, "y": 0},
        {"x": LATITUDE + 1_800_000},
        {"params": (NAN, NAN, NAN, NAN)},
        {"z": math.inf},
    ],
)
def test_content_is_not_judged_at_upload(served, wrong):
    assert upload(served, [item(0, **wrong)]) == 0


@pytest.mark.parametrize(
    ("wrong", "result"),
    [
        ({"frame": 1}, 2),
        ({"frame": 10}, 2),
        ({"frame": 99}, 2),
        ({"command": 9999}, 3),
        ({"command": 115, "frame": 2}, 3),  # CONDITION_YAW
        ({"command": 183, "frame": 2}, 3),  # DO_SET_SERVO
        ({"command": 20, "frame": 6}, 3),  # a return has no position
        ({"command": 16, "frame": 2}, 3),
        ({"command": 201, "frame": 2, "params": (3.0, 0.0, 0.0, 0.0)}, 6),
        ({"command": 5001}, 1),
        ({"command": 5100}, 1),
    ],
)
def test_rejected_items(served, wrong, result):
    assert upload(served, [item(0), item(1, **wrong)]) == result
    assert served.commander.navigator.plans.mission == ()
    assert upload(served, [item(0)]) == 0  # the rejection ended the transfer


@pytest.mark.parametrize(
    ("kind", "items", "result"),
    [(0, 65535, 4), (1, 64, 4), (2, 32, 4), (99, 1, 4), (0, 0, 0), (1, 0, 0), (99, 0, 0)],
)
def test_rejected_and_empty_counts(served, kind, items, result):
    (answer,) = served.ask(number(items, kind))
    assert (kind_of(answer), answer.type, answer.mission_type) == ("MISSION_ACK", result, kind)


def test_a_second_client_is_rejected_during_an_upload(served):
    served.ask(number(2))
    served.ask(item(0))
    (answer,) = served.ask(number(1), served.other)
    assert answer.type == 1
    assert (answer.target_system, answer.target_component) == (0, 0)  # as in PX4, on a link without a partner yet
    (answer,) = served.ask(item(1))
    assert answer.type == 0
    assert upload(served, [item(0)], link=served.other) == 0


def test_an_item_without_upload(served):
    (answer,) = served.ask(item(0))
    assert answer.type == 1
    assert texts(served) == ["IGN MISSION_ITEM: No transfer"]


def test_the_last_item_again_is_acknowledged_again(served):
    assert upload(served, [item(0), item(1)]) == 0
    assert served.ask(item(1))[0].type == 0
    assert served.ask(item(0))[0].type == 1


def test_wrong_and_repeated_numbers_are_ignored_and_requested_again(served):
    served.ask(number(3))
    served.ask(item(0))
    assert served.ask(item(2)) == []
    assert served.ask(item(0)) == []
    start = served.autopilot.time_us
    found = run(served, 0.6)
    assert [(name, m.seq) for _, name, m in found] == [("MISSION_REQUEST_INT", 1)] * 2
    assert (found[0][0] - start) * 1e-6 == pytest.approx(0.27, abs=0.02)


def test_an_item_of_another_kind_is_an_error(served):
    served.ask(number(2))
    assert served.ask(item(0, kind=1))[0].type == 1


def test_silence_ends_an_upload_after_five_seconds(served):
    served.ask(number(2))
    start = served.autopilot.time_us
    requests = run(served, 4.9)
    assert len(requests) == pytest.approx(18, abs=1)
    assert texts(served) == []
    run(served, 0.2)
    assert texts(served) == ["Operation timeout"]
    assert run(served, 2.0) == []
    assert (served.autopilot.time_us - start) > 7e6
    assert upload(served, [item(0)]) == 0


def test_the_count_again_is_answered_with_the_first_request(served):
    served.ask(number(2))
    assert [m.seq for m in served.ask(number(2))] == [0]
    served.ask(item(0))
    assert served.ask(number(2))[0].type == 1
    assert texts(served) == ["WPM: REJ. CMD: Busy"]


def test_a_client_may_cancel(served):
    served.ask(number(2))
    served.ask(ack(15))
    assert run(served, 1.0) == []
    assert upload(served, [item(0)]) == 0


def test_an_unsupported_request_is_repeated_in_the_other_form(served):
    assert names(served.ask(number(2))) == ["MISSION_REQUEST"]
    assert names(served.ask(ack(3))) == ["MISSION_REQUEST_INT"]


def test_a_closed_client_does_not_block_the_others(served):
    served.ask(number(2))
    served.link.open = False
    run(served, 0.1)
    assert upload(served, [item(0)], link=served.other) == 0


# download


def test_a_mission_round_trips(served):
    items = [
        item(0, 22, params=(0.0, 0.0, 0.0, NAN)),
        item(1, 16, frame=5, params=(3.0, 1.5, 0.0, -90.0)),
        item(2, 206, frame=2, params=(20.0, 0.0, 1.0, 0.0), x=0, y=0, z=0.0),
        item(3, 20, frame=2, x=0, y=0, z=0.0),
    ]
    assert upload(served, items) == 0
    back = download(served)
    assert [(m.seq, m.command, m.frame, m.current) for m in back] == [
        (0, 22, 6, 1), (1, 16, 5, 0), (2, 206, 2, 0), (3, 20, 2, 0)
    ]  # fmt: skip
    assert [(m.x, m.y, m.z) for m in back[:2]] == [(m.x, m.y, m.z) for m in items[:2]]
    assert (back[1].param1, back[1].param2, back[1].param4) == (3.0, 1.5, 270.0)
    assert math.isnan(back[0].param4)
    assert back[2].param1 == 20.0


def test_the_old_request_gets_the_old_item(served):
    upload(served, [item(0, frame=6)])
    served.ask(mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, 0))
    (answer,) = served.ask(mavlink.MAVLink_mission_request_message(SYSTEM, 1, 0, 0))
    assert (kind_of(answer), answer.frame) == ("MISSION_ITEM", 3)
    assert answer.x == pytest.approx(LATITUDE * 1e-7, abs=1e-5)


def test_fence_and_rally_points_round_trip(served):
    square = [item(i, 5001, kind=1, params=(4.0, 0.0, 0.0, 0.0)) for i in range(4)]
    assert upload(served, square, kind=1) == 0
    assert upload(served, [item(0, 5100, kind=2)], kind=2) == 0
    assert [(m.command, m.param1, m.mission_type) for m in download(served, 1)] == [(5001, 4.0, 1)] * 4
    assert [m.command for m in download(served, 2)] == [5100]
    assert served.commander.navigator.plans.mission == ()


def test_a_fence_polygon_of_two_corners_clears_the_fence(served):
    upload(served, [item(0, 5003, kind=1, params=(50.0, 0.0, 0.0, 0.0))], kind=1)
    assert upload(served, [item(0, 5001, kind=1, params=(2.0, 0.0, 0.0, 0.0))], kind=1) == 1
    assert served.commander.navigator.plans.items[plan.FENCE] == ()


def test_an_unexpected_request_ends_the_download(served):
    upload(served, [item(i) for i in range(4)])
    served.ask(mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, 0))
    (answer,) = served.ask(mavlink.MAVLink_mission_request_int_message(SYSTEM, 1, 2, 0))
    assert answer.type == 1
    assert "WPM: REJ. CMD: Req. WP was unexpected" in texts(served)
    assert served.ask(mavlink.MAVLink_mission_request_int_message(SYSTEM, 1, 0, 0)) == []


def test_an_item_may_be_requested_again(served):
    upload(served, [item(i) for i in range(3)])
    served.ask(mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, 0))
    ask = mavlink.MAVLink_mission_request_int_message(SYSTEM, 1, 0, 0)
    assert [served.ask(ask)[0].seq for _ in range(3)] == [0, 0, 0]


def test_an_unclosed_download_times_out(served):
    upload(served, [item(0)])
    served.ask(mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, 0))
    texts(served)
    run(served, 5.1)
    assert texts(served) == ["Operation timeout"]


# clear, current, progress


def test_clearing(served):
    upload(served, [item(0)])
    upload(served, [item(0, 5100, kind=2)], kind=2)
    (answer,) = served.ask(mavlink.MAVLink_mission_clear_all_message(SYSTEM, 1, 0))
    assert (answer.type, answer.mission_type) == (0, 0)
    assert [len(items) for items in served.commander.navigator.plans.items] == [0, 0, 1]
    (answer,) = served.ask(mavlink.MAVLink_mission_clear_all_message(SYSTEM, 1, 255))
    assert (answer.type, answer.mission_type) == (0, 255)
    assert served.commander.navigator.plans.items == [(), (), ()]


def test_set_current(served):
    upload(served, [item(i) for i in range(3)])
    texts(served)
    served.ask(mavlink.MAVLink_mission_set_current_message(SYSTEM, 1, 2))
    told = [m.seq for _, name, m in run(served, 0.2) if name == "MISSION_CURRENT"]
    assert told == [2]
    served.ask(mavlink.MAVLink_mission_set_current_message(SYSTEM, 1, 3))
    assert texts(served) == ["WPM: WP CURR CMD: Not in list"]
    assert served.commander.navigator.plans.current == 2


def test_the_current_item_is_sent_at_1_hz_during_a_mission(served):
    assert run(served, 3.0) == []
    upload(served, [item(0), item(1)])
    found = [(name, m.seq, m.total, m.mission_state) for _, name, m in run(served, 5.0)]
    assert set(found) == {("MISSION_CURRENT", 0, 0, 0)}
    assert len(found) == pytest.approx(6, abs=1)
    served.ask(mavlink.MAVLink_mission_clear_all_message(SYSTEM, 1, 0))
    assert run(served, 3.0) == []


def test_a_reached_item_is_sent_eleven_times(served):
    upload(served, [item(0), item(1)])
    run(served, 0.2)
    served.commander.navigator.mission.reached = 0
    found = [m.seq for _, name, m in run(served, 20.0) if name == "MISSION_ITEM_REACHED"]
    assert found == [0] * 11


def test_camera_triggers_are_reported(served):
    served.commander.navigator.payload.execute(plan.START_IMAGES, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0))
    upload(served, [item(0)])
    found = [m.seq for _, name, m in run(served, 0.2) if name == "CAMERA_TRIGGER"]
    assert found == [1]


def test_do_set_mission_current_is_unsupported_and_a_start_needs_a_mission(served):
    assert served.command(224, 0)[0] == 3
    assert served.command(300, 0, 0) == (2, ["Mission start denied! No valid mission"])
    upload(served, [item(0, 22), item(1)])
    assert served.command(300, 5, 0)[0] == 2
    assert served.command(300, NAN, 0)[0] == 2
    result, said = served.command(300, 0, 0)
    assert result == 0
    assert {"Armed by mission start", "Takeoff to 10.0 meters above home"} <= set(said)
    assert served.commander.armed


def test_landing_targets_need_the_local_frame(served):
    def target(frame, valid):
        return mavlink.MAVLink_landing_target_message(
            0, 0, frame, 0.1, 0, 5.0, 0, 0, 1.0, 2.0, 0.5, (1, 0, 0, 0), 0, valid
        )

    served.ask(target(8, 1))
    assert texts(served) == ["landing target: coordinate frame 8 unsupported"]
    landing = served.commander.navigator.precision_landing
    assert landing.target is None
    served.ask(target(1, 1))
    assert landing.target.position == (1.0, 2.0, 0.5)
    served.ask(target(0, 0))
    assert landing.target.position == pytest.approx((5.0 * math.tan(0.1), 0.0, 5.0), abs=1e-6)


# a bad line


class LossyClient:
    """A client after QGroundControl, on a link that loses messages in both directions."""

    def __init__(self, served, loss, seed):
        self.served = served
        self.loss = loss
        self.rng = random.Random(seed)
        self.inbox = []

    def send(self, message):
        if self.rng.random() >= self.loss:
            self.take((kind_of(m), m) for m in self.served.ask(message))

    def take(self, messages):
        self.inbox += [entry for entry in messages if self.rng.random() >= self.loss]

    def wait(self, *wanted):
        """Return the next of the ``wanted`` messages within 1.5 s, None if there is none."""
        for _ in range(75):
            while self.inbox:
                name, message = self.inbox.pop(0)
                if name in wanted:
                    return message
            self.take((name, m) for _, name, m in run(self.served, 0.02))
        return None

    def upload(self, items):
        self.send(number(len(items)))
        last = number(len(items))
        for _ in count():
            answer = self.wait("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK")
            if answer is not None and kind_of(answer) == "MISSION_ACK":
                return answer.type
            last = last if answer is None else items[answer.seq]
            self.send(last)

    def download(self):
        ask = mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, 0)
        self.send(ask)
        while (total := self.wait("MISSION_COUNT")) is None:
            self.send(ask)
        found = []
        for seq in range(total.count):
            ask = mavlink.MAVLink_mission_request_int_message(SYSTEM, 1, seq, 0)
            self.send(ask)
            while (answer := self.wait("MISSION_ITEM_INT")) is None or answer.seq != seq:
                self.send(ask)
            found.append(answer)
        self.send(ack())
        return found


@pytest.mark.parametrize("seed", range(5))
def test_transfers_survive_a_lossy_line(served, seed):
    items = [item(i, params=(float(i), 0.0, 0.0, 0.0)) for i in range(60)]
    client = LossyClient(served, 0.05, seed)
    assert client.upload(items) == 0
    assert [m.param1 for m in client.download()] == [m.param1 for m in items]
