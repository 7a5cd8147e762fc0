"""Reallocated paths: complete, in order, with balanced loads; evidence, candidates and the coverage map."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_coordination.search.assigned_mission import AssignedMission
from xtdrone_coordination.search.coverage_map import OUTSIDE, SEEN, UNSEEN, CoverageMap
from xtdrone_coordination.search.losses import cut, share_out
from xtdrone_coordination.search.people.candidates import Candidate, Evidence, nearest
from xtdrone_coordination.search.planning.coverage_path import Waypoint, length
from xtdrone_coordination.search.planning.plans import DatumSettings
from xtdrone_coordination.search.planning.region import make_region

REST = [
    Waypoint(0.0, 0.0, 0.0),
    Waypoint(100.0, 0.0, 0.0),
    Waypoint(100.0, 20.0, math.pi),
    Waypoint(0.0, 20.0, math.pi),
]


def test_parts_are_the_whole_path_and_even_out_the_loads() -> None:
    loads = {"a": 0.0, "b": 60.0, "c": 500.0}
    parts = share_out(REST, {"a": (0.0, 20.0), "b": (-5.0, 0.0), "c": (50.0, 0.0)}, loads)
    assert list(parts) == ["b", "a"]  # b ends nearest to the start of the path; c has enough work
    assert {name: length(part) + loads[name] for name, part in parts.items()} == pytest.approx({"a": 140.0, "b": 140.0})
    assert parts["b"][0] == REST[0]
    assert parts["a"][-1] == REST[-1]
    assert parts["b"][-1] == parts["a"][0] == Waypoint(80.0, 0.0, 0.0)


def test_a_single_vehicle_gets_the_whole_path() -> None:
    assert share_out(REST, {"a": (0.0, 0.0)}, {"a": 1e4}) == {"a": REST}


@pytest.mark.parametrize("at", [0.0, 30.0, 100.0, 150.0, 220.0])
def test_cuts_keep_the_length_and_the_heading(at: float) -> None:
    first, second = cut(REST, at)
    assert length(first) == pytest.approx(at)
    assert length(first) + length(second) == pytest.approx(length(REST))
    assert (first[-1].x, first[-1].y) == (second[0].x, second[0].y)
    for a, b in pairwise(first):
        if math.dist((a.x, a.y), (b.x, b.y)) > 0.0 and a.y == b.y:
            assert math.cos(b.heading) == pytest.approx(math.copysign(1.0, b.x - a.x))


def test_evidence_adds_log_odds() -> None:
    evidence = Evidence()
    for probability in (0.9, 0.9, 1.0):
        evidence.hit(probability)
    evidence.miss()
    assert evidence.log_odds == pytest.approx(2.0 * math.log(9.0) + math.log(19.0) - 1.5)  # 1 counts as 0.95
    assert (evidence.pictures, evidence.hits, evidence.mean) == (4, 3, pytest.approx(0.7))


def test_the_position_of_a_candidate_is_extrapolated() -> None:
    walker = Candidate((10.0, 0.0), (1.0, 0.0), (1.0, 0.0, 0.0, 1.0), seen_at=5.0)
    assert walker.place(7.0) == (12.0, 0.0)
    assert walker.place(60.0) == (13.0, 0.0)  # for 3 s at most
    assert nearest([walker], (14.0, 0.0), 7.0, 3.0) is walker
    assert nearest([walker], (16.0, 0.0), 7.0, 3.0) is None


def test_a_rejected_candidate_does_not_move() -> None:
    """A circling camera measures a velocity of standing objects, which must not split them into two candidates."""
    post = Candidate((10.0, 0.0), (2.5, 0.0), (1.0, 0.0, 0.0, 1.0), seen_at=20.0)
    assert nearest([post], (10.0, 0.0), 30.0, 6.0) is None
    post.status = "rejected"
    assert nearest([post], (10.0, 0.0), 30.0, 6.0) is post


def test_the_coverage_map_marks_the_ground_below_a_camera_pointing_down() -> None:
    camera = Pinhole(100, 100, 50.0, 50.0, 50.0, 50.0)  # 45 degrees to each side
    down = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # columns: right, down, ahead
    region = make_region([(-20, -20), (20, -20), (20, 20), (-20, 20)])
    coverage = CoverageMap(region, camera, pixels=0.0, cell=0.2)
    coverage.add_picture(np.array([0.0, 0.0, 10.0]), down)
    head = 10.0 - 1.7  # the head limits the area, not the foot
    assert coverage.area == pytest.approx((2.0 * head) ** 2, rel=0.02)
    assert coverage.fraction == pytest.approx(coverage.area / 1600.0)
    before = coverage.area
    coverage.add_picture(np.array([0.0, 0.0, 10.0]), down)
    assert coverage.area == before


def test_the_grid_of_a_coverage_map_has_its_cells() -> None:
    region = make_region([(0.0, 0.0), (10.0, 0.0), (0.0, 6.0)])  # a triangle: some cells are outside
    coverage = CoverageMap(region, Pinhole(100, 100, 50.0, 50.0, 50.0, 50.0), pixels=0.0)
    corner, cell, values = coverage.grid()
    assert (corner, cell, values.shape) == ((0.0, 0.0), 1.0, (10, 6))
    assert (values[0, 0], values[9, 5]) == (UNSEEN, OUTSIDE)
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    coverage.add_picture(np.array([0.0, 0.0, 5.0]), down)
    seen = coverage.grid().values
    assert seen[0, 0] == seen[2, 2] == SEEN
    assert seen[7, 0] == UNSEEN  # within 3.3 m of the camera, a person does not fit with head and foot
    assert np.array_equal(seen == OUTSIDE, values == OUTSIDE)
    assert coverage.fraction == np.mean(seen[seen != OUTSIDE] == SEEN)


def test_a_path_without_headings_looks_ahead() -> None:
    datum = DatumSettings()
    places = [(10.0, 0.0), (10.0, 30.0), (-20.0, 30.0)]
    items = tuple(PlanItem(16, 3, (0.0, 0.0, 0.0, math.nan), *datum.place(*place), 15.0) for place in places)
    mission = AssignedMission(datum)
    mission.load(items)
    ahead = [(math.cos(waypoint.heading), math.sin(waypoint.heading)) for _, waypoint in mission.path]
    assert np.allclose(ahead, [(0.0, 1.0), (0.0, 1.0), (-1.0, 0.0)], atol=1e-6)
    assert (mission.height, mission.lowest, mission.end) == (15.0, 15.0, 3)
    mission.progress = (1, (10.0, 20.0))
    assert [(round(w.x, 6), round(w.y, 6)) for w in mission.unseen_path] == [(10.0, 20.0), (10.0, 30.0), (-20.0, 30.0)]
