"""Messages by radio: range, delay, loss, bursts and bandwidth, all decided by the seed alone."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_control.network.message_radio import MessageRadio
from xtdrone_control.network.network_options import RATE, NetworkOptions

LINE = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [25.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])


def test_an_ideal_radio_reaches_all_others_at_once():
    radio = MessageRadio(4, NetworkOptions())
    assert radio.send(2.5, 1, 800, LINE) == [(2.5, 0), (2.5, 2), (2.5, 3)]


def test_range_is_from_the_sender_and_unknown_places_are_out_of_it():
    radio = MessageRadio(4, NetworkOptions(range=16.0, delay=0.1))
    assert [receiver for _, receiver in radio.send(0.0, 1, 800, LINE)] == [0, 2]
    assert [receiver for _, receiver in radio.send(0.0, 0, 800, LINE)] == [1]
    assert radio.send(0.0, 3, 800, LINE) == []
    assert (radio.sent, radio.out_of_range, radio.lost) == (3, 1 + 2 + 3, 0)


def test_jitter_is_uniform_above_the_delay():
    radio = MessageRadio(2, NetworkOptions(delay=0.3, jitter=0.2), seed=4)
    delays = np.array([radio.send(k, 0, 100, LINE[:2])[0].time - k for k in range(4000)])
    assert delays.min() >= 0.3 - 1e-9
    assert delays.max() < 0.5
    assert delays.mean() == pytest.approx(0.4, abs=0.005)
    assert delays.std() == pytest.approx(0.2 / 12**0.5, abs=0.003)


@pytest.mark.parametrize("burst", [0.0, 0.5])
def test_losses_have_their_share_and_their_length(burst):
    radio = MessageRadio(2, NetworkOptions(loss=0.2, burst=burst), seed=7)
    lost = np.array([not radio.send(k / RATE, 0, 100, LINE[:2]) for k in range(30000)])
    assert lost.mean() == pytest.approx(0.2, abs=0.02)
    runs = np.diff(np.flatnonzero(np.diff(lost.astype(int), prepend=0, append=0)))[::2]
    expected = burst * RATE if burst else 1.0 / (1.0 - 0.2)
    assert runs.mean() == pytest.approx(expected, rel=0.1)


def test_receivers_lose_different_messages():
    radio = MessageRadio(3, NetworkOptions(loss=0.5), seed=1)
    heard = [tuple(receiver for _, receiver in radio.send(k, 0, 100, LINE[:3])) for k in range(400)]
    assert {heard.count(pair) > 60 for pair in ((), (1,), (2,), (1, 2))} == {True}


def test_a_message_takes_its_bits_at_the_senders_share_of_the_bandwidth():
    radio = MessageRadio(3, NetworkOptions(range=16.0, bandwidth=1000.0, queue=2))
    first = radio.send(0.0, 0, 500, LINE[:3])
    assert first == [(pytest.approx(1.5), 1)]  # vehicle 1 receives from three, itself included: a third of 1000 bit/s
    assert radio.send(0.1, 0, 500, LINE[:3]) == [(pytest.approx(3.0), 1)]
    assert radio.send(0.2, 0, 500, LINE[:3]) == []  # two are waiting or leaving
    assert radio.lost == 1
    assert radio.send(1.6, 0, 500, LINE[:3]) == [(pytest.approx(4.5), 1)]


def test_only_the_seed_decides():
    def fate(seed, others):
        radio = MessageRadio(3, NetworkOptions(loss=0.4, jitter=0.1), seed)
        found = []
        for k in range(50):
            found.append(radio.send(0.1 * k, 0, 100, LINE[:3]))
            if others:
                radio.send(0.1 * k, 1, 100, LINE[:3])
        return found

    assert fate(5, others=False) == fate(5, others=True) != fate(6, others=False)


def test_a_restart_repeats_the_same_fate():
    radio = MessageRadio(2, NetworkOptions(loss=0.4, jitter=0.1), 3)
    first = [radio.send(k, 0, 100, LINE[:2]) for k in range(20)]
    radio.restart()
    assert [radio.send(k, 0, 100, LINE[:2]) for k in range(20)] == first


@pytest.mark.parametrize(("count", "seed", "text"), [(0, 0, "0 vehicles"), (2, -1, "network seed: -1")])
def test_bad_numbers_are_refused(count, seed, text):
    with pytest.raises(ValueError, match=text):
        MessageRadio(count, NetworkOptions(), seed)


def test_topics_are_named_with_their_types():
    pytest.importorskip("rospy")
    from std_msgs.msg import String

    from xtdrone_control.network.radio_node import message_types

    assert message_types("/a/b:std_msgs/String, c:std_msgs/String") == {"a/b": String, "c": String}
    for given in ("", "a", "a:String", "a:std_msgs/Nothing", ":std_msgs/String", 7):
        with pytest.raises(ValueError, match=r"~topics: .* is not allowed"):
            message_types(given)
