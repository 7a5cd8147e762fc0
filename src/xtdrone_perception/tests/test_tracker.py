"""Tracks: identity, beginning and end, and the consistency of the filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_perception.tracking.geolocation import GroundPoint
from xtdrone_perception.tracking.tracker import GroundDetection, Tracker, TrackerSettings

SIGMA = 0.2


def find(x, y, probability=0.9, sigma=SIGMA, shared=0.5, object_class="human") -> GroundDetection:
    flat = np.diag([1.0, 1.0, 0.0])
    return GroundDetection(
        GroundPoint(np.array([x, y, 0.0]), sigma**2 * flat, shared**2 * flat), object_class, probability
    )


def place(track):
    return track.position[:2].tolist()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("along", [1.0, -1.0])
def test_two_people_passing_at_one_metre_keep_their_ids(seed, along):
    """They walk towards each other, or one overtakes the other; one picture in five shows only one of them."""
    random = np.random.default_rng(seed)
    bias = random.normal(0.0, 0.5, 2)  # error of the vehicle's position, the same in all pictures
    speeds = (1.3, -1.3) if along > 0 else (1.5, 0.4)
    starts = (-10.0, 10.0) if along > 0 else (-10.0, -1.0)
    tracker, time, ids = Tracker(), 0.0, {}
    while time < 16.0:
        truth = [np.array([x0 + v * time, y]) for x0, v, y in zip(starts, speeds, (0.5, -0.5), strict=True)]
        seen = [i for i in (0, 1) if random.random() > 0.1]
        finds = [find(*(truth[i] + bias + random.normal(0.0, SIGMA, 2))) for i in seen]
        order = random.permutation(len(finds))
        tracks = tracker.update(time, [finds[k] for k in order])
        for i in (0, 1):
            near = min(tracks, key=lambda track: math.dist(place(track), truth[i] + bias), default=None)
            if near is not None and len(tracks) == 2 and time > 4.0:
                ids.setdefault(i, set()).add(near.id)
        time += random.choice([0.3, 0.5, 0.7])
    assert {i: len(found) for i, found in ids.items()} == {0: 1, 1: 1}
    assert ids[0] != ids[1]


def test_confirmed_after_three_of_five_pictures_and_not_by_fewer():
    tracker = Tracker()
    shown = [1, 0, 1, 0, 0, 1, 1, 0, 1]
    confirmed = []
    for k, there in enumerate(shown):
        confirmed.append(len(tracker.update(0.5 * k, [find(0.0, 0.0)] if there else [])))
    # The track begins at 0, ends at 4 (three of five is no longer possible), begins again at 5, has its third hit at 8.
    assert confirmed == [0, 0, 0, 0, 0, 0, 0, 0, 1]
    (track,) = tracker.tracks
    assert (track.id, track.hits, track.probability) == (1, 3, 0.9)


def test_ends_after_misses_in_view_and_not_out_of_view():
    settings = TrackerSettings(misses=4, widest=50.0)
    hidden, shown = Tracker(settings), Tracker(settings)
    for tracker in (hidden, shown):
        for k in range(6):
            tracker.update(0.5 * k, [find(k, 0.0)])
    counts = []
    for k in range(6, 12):
        (track,) = hidden.update(0.5 * k, [], lambda place: place[0] < 0.0)
        counts.append(len(shown.update(0.5 * k, [])))
        assert (track.missed, track.probability) == (0, 0.0)
    assert counts == [1, 1, 1, 0, 0, 0]
    assert place(track) == pytest.approx([11.0, 0.0], abs=0.3)  # extrapolated with 2 m/s
    for k in range(12, 60):
        hidden.update(0.5 * k, [], lambda place: False)
    assert hidden.tracks == []  # its position is too uncertain now


def test_improbable_detections_continue_a_track_but_begin_none():
    tracker = Tracker(TrackerSettings(birth=0.6))
    for k in range(6):
        assert tracker.update(0.5 * k, [find(0.0, 0.0, 0.4)]) == []
    assert tracker.tracks == []
    for k in range(6, 10):
        tracker.update(0.5 * k, [find(0.0, 0.0, 0.7 if k == 6 else 0.3)])
    assert [track.hits for track in tracker.confirmed] == [4]


def test_of_two_equally_near_detections_the_more_probable_is_assigned():
    tracker = Tracker()
    for k in range(4):
        tracker.update(0.5 * k, [find(0.0, 0.0)])
    (track,) = tracker.update(2.0, [find(0.3, 0.0, 0.35), find(-0.3, 0.0, 0.95)])
    assert track.probability == 0.95
    assert track.state[0] < 0.0


def test_other_classes_and_distant_detections_begin_their_own_tracks():
    tracker = Tracker(TrackerSettings(confirm_hits=1, confirm_of=1))
    tracker.update(0.0, [find(0.0, 0.0)])
    tracks = tracker.update(0.5, [find(0.0, 0.0), find(0.0, 0.1, object_class="car"), find(8.0, 0.0)])
    assert [(track.id, track.object_class) for track in tracks] == [(1, "human"), (2, "car"), (3, "human")]


def test_the_covariance_matches_the_errors():
    """Normalised squared errors are chi-squared with four degrees of freedom, at uneven time steps."""
    random = np.random.default_rng(3)
    settings = TrackerSettings(acceleration=0.3, speed=1.0, confirm_hits=1, confirm_of=1)
    squares = []
    for _ in range(150):
        tracker, state, time = Tracker(settings), np.array([1.0, 2.0, *random.normal(0.0, 1.0, 2)]), 0.0
        for _ in range(12):
            step = random.uniform(0.1, 0.9)
            q = settings.acceleration**2 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
            kicks = random.multivariate_normal([0.0, 0.0], q, 2)
            state = np.concatenate([state[:2] + step * state[2:] + kicks[:, 0], state[2:] + kicks[:, 1]])
            time += step
            (track,) = tracker.update(time, [find(*(state[:2] + random.normal(0.0, SIGMA, 2)))])
        error = track.state - state
        squares.append(error @ np.linalg.solve(track.covariance, error))
    assert 3.2 < np.mean(squares) < 4.8  # 99.9 % of means of 150 lie within 4 +- 3.29 * sqrt(8 / 150) = 4 +- 0.76
    assert track.position_covariance[0, 0] == pytest.approx(track.covariance[0, 0] + 0.25)


def test_time_must_increase():
    tracker = Tracker()
    tracker.update(1.0, [find(0.0, 0.0)])
    for time in (0.9, math.nan):
        with pytest.raises(ValueError, match="time"):
            tracker.update(time, [])
    tracker.reset()
    assert tracker.update(0.1, []) == []


@pytest.mark.parametrize("wrong", [{"gate": 0.0}, {"confirm_hits": 6}, {"misses": 0}, {"birth": 2.0}, {"widest": "x"}])
def test_invalid_settings_are_rejected(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        TrackerSettings(**wrong)
