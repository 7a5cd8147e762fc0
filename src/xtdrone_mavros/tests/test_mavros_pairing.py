"""Pairs by stamp, against hand-computed cases and laws of the ApproximateTime policy."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_mavros.link.pairing import Pairing


def fed(*entries, size=10):
    """Return the pairs of stamps that each (side, stamp) completes."""
    pairing = Pairing(size)
    return [pairing.add(side, stamp, stamp) for side, stamp in entries]


def test_equal_stamps_are_a_pair_at_once():
    assert fed((0, 5), (1, 5), (1, 6), (0, 6)) == [[], [(5, 5)], [], [(6, 6)]]


def test_messages_without_stamps_pair_in_their_order():
    assert fed((0, 0), (1, 0), (0, 0), (0, 0), (1, 0)) == [[], [(0, 0)], [], [], [(0, 0)]]


def test_the_later_of_the_first_messages_waits_for_its_successors():
    assert fed((0, 100), (1, 107), (0, 108)) == [[], [], [(108, 107)]]  # 1 after is nearer than 7 before
    assert fed((0, 100), (1, 107), (0, 114)) == [[], [], [(100, 107)]]  # 7 after is not


def test_a_later_partner_counts_a_tenth_farther():
    assert fed((0, 0), (1, 110), (0, 209))[-1] == [(209, 110)]  # 1.1 * 99 < 110
    assert fed((0, 0), (1, 110), (0, 210))[-1] == [(0, 110)]  # 1.1 * 100 is not


def test_earlier_messages_are_skipped():
    assert fed((0, 1), (0, 2), (0, 3), (1, 3), (0, 4), (1, 4)) == [[], [], [], [(3, 3)], [], [(4, 4)]]


def test_a_clock_that_is_set_back_begins_again():
    assert fed((0, 100), (0, 5), (1, 5))[-1] == [(5, 5)]
    assert fed((0, 100), (1, 90), (0, 5), (1, 5))[-1] == [(5, 5)]


def test_only_the_newest_are_kept():
    stamps = [(0, stamp) for stamp in range(5)]
    assert fed(*stamps, (1, 1), (1, 3), size=3)[-2:] == [[], [(3, 3)]]


def test_nothing_is_drawn_after_clear():
    pairing = Pairing()
    pairing.add(0, 5, "a")
    pairing.clear()
    assert pairing.add(1, 5, "b") == []


@settings(max_examples=50)
@given(
    st.lists(st.tuples(st.integers(0, 1), st.integers(0, 20)), max_size=60),
    st.integers(1, 5),
)
def test_each_is_used_once_and_in_order(steps, size):
    """In each topic, at its own rate, stamps of pairs increase and no message is used twice."""
    pairing, now = Pairing(size), [0, 0]
    pairs = []
    for count, (side, step) in enumerate(steps):
        now[side] += step
        pairs += pairing.add(side, now[side], (now[side], count))
    for side in (0, 1):
        used = [pair[side] for pair in pairs]
        assert used == sorted(used)
        assert len(set(used)) == len(used)


@settings(max_examples=50)
@given(st.integers(1, 100), st.integers(-49, 49))
def test_two_regular_streams_pair_with_the_nearest(period, percent):
    """The thrust within half a period of an attitude's stamp is its partner."""
    pairing = Pairing()
    pairs = []
    for index in range(20):
        stamp = 100 * period * index
        pairs += pairing.add(0, stamp, index)
        pairs += pairing.add(1, stamp + period * percent, index)
    assert len(pairs) >= 18
    assert all(a == b for a, b in pairs)
