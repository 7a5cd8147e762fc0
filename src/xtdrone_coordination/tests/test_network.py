"""The laws of the network: arrival, delay and receivers of samples, all decided by the seed alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_control.network import channel as kernels
from xtdrone_coordination.follower import RATE, Follower
from xtdrone_coordination.known_swarm_state import SwarmState
from xtdrone_coordination.laws.topology import veteran_topology
from xtdrone_coordination.network import Network, NetworkOptions, make_network
from xtdrone_coordination.patterns import Patterns, with_leader

QUICK = settings(derandomize=True, max_examples=30, deadline=None)
FEW = settings(derandomize=True, max_examples=12, deadline=None)


def walk(count: int, turns: int, seed: int = 0, size: float = 10.0, speed: float = 3.0) -> np.ndarray:
    """Return positions of vehicles on random walks, shape (turns, count, 3)."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, speed / RATE, (turns, count, 3)).cumsum(axis=0)
    return rng.uniform(-size, size, (count, 3)) + steps


def labels(turn: int, count: int) -> np.ndarray:
    """Return velocities that encode turn and sender of a sample."""
    return np.column_stack([np.full(count, turn), np.arange(count), np.zeros(count)]).astype(float)


def fly(network: Network, track: np.ndarray) -> np.ndarray:
    """Return the turn of the sample that each vehicle holds of each other after each turn, NaN for none: (T, N, N)."""
    known = np.empty((len(track), network.count, network.count))
    for turn, positions in enumerate(track):
        network.step(positions, labels(turn, network.count))
        for i in range(network.count):
            samples = network.samples_of_all(i)
            known[turn, i] = samples.velocities[:, 0]
            heard = np.flatnonzero(samples.came >= 0)
            assert samples.velocities[heard, 1].tolist() == heard.tolist()
            assert (samples.positions[heard] == track[known[turn, i, heard].astype(int), heard]).all()
            assert np.isnan(samples.positions[samples.came < 0]).all()
    return known


def others(known: np.ndarray) -> np.ndarray:
    """Return (T, N, N) without the diagonal: (T, N (N - 1))."""
    count = known.shape[1]
    return known[:, ~np.eye(count, dtype=bool)]


def plainly(network: Network, track: np.ndarray) -> np.ndarray:
    """Return the result of :func:`fly` by delivery of message after message; for infinite bandwidth."""
    options, count, seed = network.options, network.count, network.air.seed
    memory = math.ceil(options.memory * RATE)
    newest: dict[tuple[int, int], tuple[int, int]] = {}
    under_way: list[tuple[int, int, int, int]] = []
    result = np.full((len(track), count, count), np.nan)
    for turn, x in enumerate(track):
        for j in range(count):
            for i in set(range(count)) - {j}:
                if np.linalg.norm(x[j] - x[i]) > options.range:
                    continue
                if kernels.draw(seed, kernels.LOSS, turn, j, i) < options.loss:
                    continue
                extra = options.jitter * kernels.draw(seed, kernels.JITTER, turn, j, i)
                under_way.append((turn + math.ceil((options.delay + extra) * RATE - 1e-9), turn, j, i))
        for arrival, sent, j, i in under_way:
            if arrival == turn and newest.get((i, j), (-1, 0))[0] < sent:
                newest[i, j] = (sent, arrival)
        under_way = [message for message in under_way if message[0] > turn]
        for (i, j), (sent, arrival) in newest.items():
            if turn - arrival <= memory:
                result[turn, i, j] = sent
        result[turn, range(count), range(count)] = turn
    return result


@FEW
@given(
    st.builds(
        NetworkOptions,
        range=st.one_of(st.just(math.inf), st.floats(3.0, 20.0)),
        delay=st.floats(0.0, 0.3),
        jitter=st.one_of(st.just(0.0), st.floats(0.0, 0.3)),
        loss=st.one_of(st.just(0.0), st.just(1.0), st.floats(0.0, 0.99)),
        memory=st.floats(0.01, 0.5),
    ),
    st.integers(0, 1000),
)
def test_answers_are_those_of_delivering_message_after_message(options: NetworkOptions, seed: int) -> None:
    track = walk(5, 45, seed)
    network = Network(5, options, seed)
    np.testing.assert_array_equal(fly(network, track), plainly(network, track))


def test_without_impairments_followers_fly_as_on_the_shared_state() -> None:
    count = 9
    offsets = Patterns(count).offsets("cube")
    adjacency = veteran_topology(with_leader(offsets))
    track = walk(count, 60, seed=3, size=2.5)
    track[20:50, 4] = np.nan  # one falls silent, and comes back
    network = Network(count)
    shared = SwarmState(count)
    ours = [Follower(i, count, swarm=network.known(i)) for i in range(1, count)]
    theirs = [Follower(i, count, swarm=shared) for i in range(1, count)]
    for follower in ours + theirs:
        follower.on_pattern(offsets)
        follower.on_topology(adjacency)
    for turn, positions in enumerate(track):
        velocities = labels(turn, count)
        network.step(positions, velocities)
        for j in range(count):
            shared.on_position(j, tuple(positions[j]))
            shared.on_velocity(j, tuple(velocities[j]))
        assert [f.update() for f in ours] == [f.update() for f in theirs]
        assert ours[3].swarm.fresh(4, 5) == shared.fresh(4, 5)
        assert ours[3].swarm.positions[0] == tuple(positions[0])
        shared.tick()
        network.known(1).tick()


@QUICK
@given(st.floats(0.0, 1.5))
def test_delay_selects_exactly_the_sample_of_that_age(delay: float) -> None:
    turns = math.ceil(delay * RATE - 1e-9)
    known = others(fly(Network(3, NetworkOptions(delay=delay)), walk(3, turns + 5)))
    assert np.isnan(known[:turns]).all()
    assert (known[turns:] == np.arange(5)[:, None]).all()


def test_a_delay_that_is_a_whole_number_of_turns_is_not_rounded_up() -> None:
    for turns in range(1, 60):
        assert kernels.turns_of(turns / RATE * RATE) == turns
    assert kernels.turns_of(0.1 * RATE) == 3
    assert kernels.turns_of(0.1001 * RATE) == 4


def test_jitter_varies_the_delay_and_overtaken_samples_are_ignored() -> None:
    known = others(fly(Network(6, NetworkOptions(delay=0.1, jitter=0.2), seed=5), walk(6, 200)))
    known = known[9:]
    age = np.arange(9, 200)[:, None] - known
    assert age.min() == 4  # 3 turns and a little more, rounded up
    assert age.max() <= 9
    assert len(np.unique(age)) > 3
    assert (np.diff(known, axis=0) >= 0).all()


@FEW
@given(st.floats(0.02, 0.98), st.integers(0, 2**40))
def test_losses_are_as_many_as_they_should_be(loss: float, seed: int) -> None:
    turns, count = 60, 8
    known = fly(Network(count, NetworkOptions(loss=loss), seed), walk(count, turns))
    lost = known != np.arange(turns)[:, None, None]

    def deviation(chance: float, size: int) -> float:
        return math.sqrt(max(chance * (1.0 - chance), 1.0 / size) / size)

    links = others(lost)
    assert abs(links.mean() - loss) < 5.0 * deviation(loss, links.size)
    for both in (lost[:, 0, 2:] & lost[:, 1, 2:], lost[:, 2:, 0] & lost[:, 2:, 1], links[1:] & links[:-1]):
        assert abs(both.mean() - loss**2) < 8.0 * deviation(loss**2, both.size)  # each by itself


def test_neither_all_nor_nothing_is_lost_unless_it_should() -> None:
    track = walk(4, 50)
    assert (others(fly(Network(4, NetworkOptions(loss=0.0)), track)) == np.arange(50)[:, None]).all()
    assert np.isnan(others(fly(Network(4, NetworkOptions(loss=1.0)), track))).all()
    assert np.isnan(others(fly(Network(4, NetworkOptions(loss=1.0, burst=1.0)), track))).all()


def test_bursts_have_their_length_at_the_same_loss() -> None:
    turns, count, loss, burst = 2000, 6, 0.3, 0.4
    known = others(fly(Network(count, NetworkOptions(loss=loss, burst=burst, memory=60.0), seed=2), walk(count, turns)))
    lost = known != np.arange(turns)[:, None]
    starts = (lost[1:] & ~lost[:-1]).sum()
    assert lost.mean() == pytest.approx(loss, rel=0.08)
    assert lost.sum() / starts == pytest.approx(burst * RATE, rel=0.08)


def test_nothing_is_received_from_beyond_the_range_at_sending() -> None:
    reach, turns = 8.0, 120
    track = walk(7, turns, seed=9, size=8.0, speed=12.0)
    delay = 4
    known = fly(Network(7, NetworkOptions(range=reach, delay=delay / RATE, memory=60.0)), track)
    apart = np.linalg.norm(track[:, :, None] - track[:, None], axis=-1)
    inside = apart <= reach
    assert 0.2 < inside.mean() < 0.8
    for turn in range(turns):
        for i in range(7):
            for j in set(range(7)) - {i}:
                heard = np.flatnonzero(inside[: max(0, turn - delay + 1), i, j])
                expected = heard[-1] if len(heard) else np.nan
                assert known[turn, i, j] == expected or (np.isnan(expected) and np.isnan(known[turn, i, j]))


@FEW
@given(
    st.floats(200.0, 100_000.0),
    st.integers(1, 5),
    st.one_of(st.just(math.inf), st.floats(4.0, 25.0)),
    st.integers(0, 1000),
)
def test_no_receiver_gets_more_bits_than_the_bandwidth(bandwidth: float, queue: int, reach: float, seed: int) -> None:
    count, turns, bits = 7, 120, 320
    options = NetworkOptions(range=reach, bandwidth=bandwidth, queue=queue, message_bits=bits)
    network = Network(count, options, seed)
    received = np.zeros(count)
    heard = np.full((count, count), -1.0)
    for turn, positions in enumerate(walk(count, turns, seed)):
        network.step(positions, labels(turn, count))
        for i in range(count):
            samples = network.samples_of_all(i)
            new = (samples.came == turn) & (np.arange(count) != i)
            assert (samples.velocities[new, 0] > heard[i, new]).all()
            assert (samples.velocities[new, 0] >= turn - queue + 1).all()
            heard[i, new] = samples.velocities[new, 0]
            received[i] += bits * new.sum()
        assert (received <= bandwidth * (turn + 1) / RATE).all()


def test_the_air_is_used_as_far_as_it_goes_and_shared_by_all_within_range() -> None:
    bits, turns = 320, 300
    places = np.zeros((9, 3))
    places[:6, 0] = np.arange(6)  # six together
    places[6:, 0] = 100.0 + np.arange(3)  # and three elsewhere
    network = Network(9, NetworkOptions(range=10.0, bandwidth=18 * bits, message_bits=bits))
    came = np.zeros((9, 9))
    for turn in range(turns):
        network.step(places, labels(turn, 9))
        for i in range(9):
            came[i] += network.samples_of_all(i).came == turn
    each = came / (turns / RATE)
    np.fill_diagonal(each, 0.0)
    assert each[:6, :6].sum(axis=1) == pytest.approx(15.0, rel=0.05)  # 3 Hz from each of five, of 18 in all
    assert each[6:, 6:].sum(axis=1) == pytest.approx(12.0, rel=0.05)  # 6 Hz from each of two
    assert not each[:6, 6:].any()


def test_a_longer_queue_sends_later_samples_not_more() -> None:
    ages, amounts = [], []
    for queue in (1, 4):
        network = Network(2, NetworkOptions(bandwidth=20 * 320.0, queue=queue), seed=1)
        known = fly(network, walk(2, 200))[50:, 0, 1]
        ages.append((np.arange(50, 200) - known).mean())
        amounts.append(len(np.unique(known)))
    assert amounts[0] == pytest.approx(150 / 3, abs=1)
    assert amounts[1] == pytest.approx(amounts[0], abs=1)
    assert ages[1] - ages[0] == pytest.approx(3.0, abs=0.2)


def test_enough_bandwidth_is_as_good_as_no_limit() -> None:
    known = others(fly(Network(5, NetworkOptions(bandwidth=5 * RATE * 320.0 * 1.01)), walk(5, 40)))
    assert (known[2:] == np.arange(2, 40)[:, None]).all()


HARD = NetworkOptions(range=15.0, delay=0.05, jitter=0.1, loss=0.4, bandwidth=20000.0, queue=2)


def test_the_seed_alone_decides() -> None:
    track = walk(6, 80)
    first = fly(Network(6, HARD, seed=8), track)
    np.testing.assert_array_equal(first, fly(Network(6, HARD, seed=8), track))
    assert not np.array_equal(first, fly(Network(6, HARD, seed=9), track), equal_nan=True)
    again = Network(6, HARD, seed=8)
    again.step(track[0] + 5.0, labels(0, 6))
    assert again.known(2).positions[2] == tuple(track[0, 2] + 5.0)
    again.restart()
    assert again.turn == -1
    again.step(track[0], labels(0, 6))
    assert again.known(2).positions[2] == tuple(track[0, 2])
    again.restart()
    np.testing.assert_array_equal(first, fly(again, track))


@pytest.mark.parametrize("options", [HARD, dataclasses.replace(HARD, burst=0.3)])
def test_queries_in_any_order_or_none_give_the_same_result(options: NetworkOptions) -> None:
    track = walk(6, 60)
    asked, silent = Network(6, options, seed=3), Network(6, options, seed=3)
    known = fly(asked, track)
    for turn, positions in enumerate(track):
        silent.step(positions, labels(turn, 6))
    rng = np.random.default_rng(0)
    receivers, senders = rng.permutation(np.argwhere(np.ones((6, 6)))).T
    samples = silent.samples(receivers, senders)
    np.testing.assert_array_equal(samples.velocities[:, 0], known[-1][receivers, senders])


def test_the_numbering_of_vehicles_does_not_matter() -> None:
    """The laws hold for any numbering in networks without random impairments; draws depend on the numbers."""
    options = NetworkOptions(range=9.0, delay=0.08)
    track = walk(8, 50)
    order = np.random.default_rng(1).permutation(8)
    known, renumbered = fly(Network(8, options), track), fly(Network(8, options), track[:, order])
    np.testing.assert_array_equal(renumbered, known[:, order][:, :, order])


def test_losses_of_a_link_are_independent_of_the_number_of_vehicles() -> None:
    options = NetworkOptions(loss=0.5, jitter=0.1)
    track = walk(8, 50)
    small, large = fly(Network(5, options), track[:, :5]), fly(Network(8, options), track)
    np.testing.assert_array_equal(small, large[:, :5, :5])


def test_received_samples_expire_but_not_the_own_state() -> None:
    network = Network(2, NetworkOptions(memory=0.5))
    track = walk(2, 40)
    track[10:] = np.nan
    positions: list[list] = [[], []]
    for turn, x in enumerate(track):
        network.step(x, labels(turn, 2))
        for j in range(2):
            positions[j].append(network.known(0).positions[j])
    assert positions[1][9:25] == [tuple(track[9, 1])] * 16
    assert positions[1][25:] == [None] * 15
    assert positions[0][9:] == [tuple(track[9, 0])] * 31
    assert not network.known(0).fresh(0, 29)
    assert network.known(0).fresh(0, 30)


def test_known_states_behave_like_a_list() -> None:
    network = Network(30, NetworkOptions(loss=0.5, memory=0.1), seed=1)
    track = walk(30, 3)
    for turn, x in enumerate(track):
        network.step(x, labels(turn, 30))
    known, samples = network.known(7), network.samples_of_all(7)
    expected = [
        tuple(p) if came >= 0 else None for p, came in zip(samples.positions.tolist(), samples.came, strict=True)
    ]
    assert None in expected
    assert [known.positions[j] for j in range(30)] == expected  # more than a few
    assert list(known.positions) == known.positions[:] == expected
    assert known.positions[-1] == expected[-1]
    assert known.positions[3:9] == expected[3:9]
    assert len(known.velocities) == 30
    assert known.velocities[7] == (2.0, 7.0, 0.0)
    assert [known.fresh(j, 0) for j in range(30)] == (samples.came == 2).tolist()
    with pytest.raises(IndexError):
        known.positions[30]
    with pytest.raises(IndexError):
        known.fresh(30, 0)
    network.step(track[0], labels(3, 30))
    assert known.velocities[7] == (3.0, 7.0, 0.0)


def test_a_restarted_vehicle_receives_later_samples() -> None:
    network = Network(3, NetworkOptions(delay=0.1))
    track = walk(3, 12)
    for turn in range(8):
        network.step(track[turn], labels(turn, 3))
    first, second = network.known(1), network.known(2)
    assert None not in first.positions
    first.restart()
    assert list(first.positions) == list(first.velocities) == [None] * 3
    assert not first.fresh(0, 100)
    assert None not in second.positions
    network.step(track[8], labels(8, 3))
    assert list(first.positions) == [tuple(track[5, 0]), tuple(track[8, 1]), tuple(track[5, 2])]
    with pytest.raises(TypeError, match="over its network only"):
        first.on_position(0, (0.0, 0.0, 0.0))


@FEW
@given(st.integers(0, 1000), st.floats(0.5, 4.0), st.sampled_from([NetworkOptions(), HARD]))
def test_those_near_are_found_by_where_they_are_believed_to_be(
    seed: int, radius: float, options: NetworkOptions
) -> None:
    count = 40
    network = Network(count, options, seed)
    track = walk(count, 50, seed, size=5.0, speed=20.0)
    track[20:, 7] = np.nan
    for turn, positions in enumerate(track):
        network.step(positions, labels(turn, count))
        if turn == 30:
            network.forget(5)
        if turn not in (0, 5, 20, 30, 49):
            continue
        near = network.near(radius)
        for i in range(count):
            known = list(network.known(i).positions)
            own = known[i]
            entries = slice(near.start[i], near.start[i + 1])
            expected = [
                j for j, p in enumerate(known) if own and p and j != i and np.linalg.norm(np.subtract(p, own)) < radius
            ]
            assert near.others[entries].tolist() == expected
            assert [tuple(p) for p in near.positions[entries].tolist()] == [known[j] for j in expected]


def test_vehicles_out_of_reach_of_the_leader_are_reported() -> None:
    network = Network(6, NetworkOptions(range=5.0))
    places = np.array([[0.0, 0, 0], [4, 0, 0], [8, 0, 0], [20, 0, 0], [22, 0, 0], [1, 0, 0]])
    adjacency = np.zeros((6, 6))
    adjacency[[1, 2, 3, 4, 5], [0, 1, 2, 3, 4]] = 1.0  # a chain; 5 listens to 4 alone, although it is near the leader
    network.step(places, np.zeros((6, 3)))
    assert network.unreachable(adjacency) == [3, 4, 5]
    assert network.unreachable(np.nonzero(adjacency)) == [3, 4, 5]
    adjacency[5, 0] = 1.0
    assert network.unreachable(adjacency) == [3, 4]
    network.step(np.where(np.arange(6)[:, None] == 1, np.nan, places), np.zeros((6, 3)))
    assert network.unreachable(adjacency) == [3, 4]  # assumed at its last known position
    places[3:5, 0] -= 8.0
    network.step(places, np.zeros((6, 3)))
    assert network.unreachable(adjacency) == []
    lossy = Network(6, NetworkOptions(loss=1.0))
    lossy.step(places, np.zeros((6, 3)))
    assert lossy.unreachable(adjacency) == [1, 2, 3, 4, 5]
    with pytest.raises(ValueError, match="listens to itself"):
        network.unreachable(np.eye(6))


def test_an_ideal_network_is_omitted() -> None:
    assert make_network(9, None) is None
    assert make_network(9, NetworkOptions(burst=1.0, queue=4)) is None
    network = make_network(9, NetworkOptions(loss=0.1), seed=3)
    assert network is not None
    assert (network.count, network.seed, network.turn) == (9, 3, -1)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("range", 0.0, "network range: 0.0 is not allowed, above 0 m"),
        ("range", math.nan, "network range: nan is not allowed"),
        ("range", "far", "network range: 'far' is not allowed, above 0 m"),
        ("delay", -0.1, "network delay: -0.1 is not allowed, 0 to 60 s"),
        ("delay", math.inf, "network delay: inf is not allowed, 0 to 60 s"),
        ("jitter", math.nan, "network jitter: nan is not allowed, 0 to 60 s"),
        ("loss", 1.01, "network loss: 1.01 is not allowed, 0 to 1"),
        ("loss", True, "network loss: True is not allowed, 0 to 1"),
        ("burst", 61, "network burst: 61 is not allowed, 0 to 60 s"),
        ("burst", 0.03, "network burst: 0.03 is not allowed, 0 or at least 0.03333 s"),
        ("bandwidth", -1, "network bandwidth: -1 is not allowed, above 0"),
        ("bandwidth", math.nan, "network bandwidth: nan is not allowed"),
        ("message_bits", 0, "network message_bits: 0 is not allowed, a whole number, at least 1 bit"),
        ("message_bits", 1.5, "network message_bits: 1.5 is not allowed"),
        ("queue", 0, "network queue: 0 is not allowed, a whole number from 1 to 1000"),
        ("queue", 1001, "network queue: 1001 is not allowed"),
        ("memory", 0, "network memory: 0 is not allowed, above 0 and at most 60 s"),
    ],
)
def test_options_are_checked(name: str, value: object, message: str) -> None:
    with pytest.raises(ValueError, match="^" + message.replace(".", r"\.")):
        NetworkOptions(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda: Network(0), "network: 0 vehicles are not allowed, 1 or more"),
        (lambda: Network(3, seed=-1), "network seed: -1 is not allowed, 0 or more"),
        (lambda: Network(3).known(3), "network: vehicle 3 does not exist, 0 to 2"),
        (lambda: Network(3).samples(np.array([0, 1]), np.array([2, 3])), "network: vehicle 3 does not exist, 0 to 2"),
        (lambda: Network(3).samples(np.array([-1]), np.array([2])), "network: vehicle -1 does not exist, 0 to 2"),
        (lambda: Network(3).samples(np.array([1]), np.array([0, 2])), "network: 1 receivers and 2 senders"),
        (lambda: Network(3).step(np.zeros((2, 3)), np.zeros((3, 3))), r"network positions: shape \(2, 3\)"),
        (lambda: Network(3).step(np.zeros((3, 3)), np.zeros(3)), r"network velocities: shape \(3,\) .* \(3, 3\)"),
    ],
)
def test_wrong_use_is_reported(what: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        what()
