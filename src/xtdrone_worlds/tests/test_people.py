"""People's bodies, postures and files."""

import multiprocessing
from itertools import pairwise

import numpy as np
import pytest

from xtdrone_worlds.worlds import people_meshes

NAMES = people_meshes.names()


@pytest.mark.parametrize("name", NAMES)
def test_body_is_whole(name):
    body = people_meshes.read(name)
    assert np.allclose(body.weights.sum(axis=1), 1.0)
    assert body.triangles.max() == len(body.vertices) - 1
    assert body.texture_triangles.max() == len(body.texture_points) - 1
    assert 1.45 < body.height < 2.0
    assert 1000 < len(body.triangles) < 3000
    for pose in range(len(body.poses)):
        points = body.posture(pose)
        assert points[:, 2].min() == pytest.approx(0.0, abs=0.002)
        # Shoes, hair and hat on top; knees that bend below.
        assert body.height - 0.09 < points[:, 2].max() < body.height + 0.12
        assert np.ptp(points[:, 1]) < 0.95


@pytest.mark.parametrize("name", NAMES)
def test_standing_foot_goes_back_with_the_ground(name):
    body = people_meshes.read(name)
    frames = len(body.poses) - 1
    # Flat on the ground from 8 % to 38 % of the cycle; the right foot half a cycle later.
    flat = [i for i in range(frames) if 0.08 <= i / frames <= 0.37]
    feet = body.posture(0)[:, 2] < 0.03
    for side, shift in ((1.0, 0), (-1.0, frames // 2)):
        sole = feet & (body.posture(0)[:, 1] * side > 0.0)
        way = [body.posture(1 + (i + shift) % frames)[sole] for i in flat]
        for before, after in pairwise(way):
            moved = (after - before).mean(axis=0)
            assert moved[0] == pytest.approx(-body.stride / frames, abs=0.006)
            assert abs(moved[1]) < 0.006
        assert all(np.median(points[:, 2]) < 0.03 for points in way)


def test_splits_share_no_person():
    train, test = people_meshes.names("train"), people_meshes.names("test")
    assert sorted(train + test) == NAMES
    assert not set(train) & set(test)
    with pytest.raises(ValueError, match=r"split: 'all' is not allowed, train or test"):
        people_meshes.names("all")
    with pytest.raises(ValueError, match="person: 'unknown' is not known, there are "):
        people_meshes.load("unknown")


def _load(cache, name):
    import os

    os.environ["XDG_CACHE_HOME"] = str(cache)
    return [str(visual.geometry.path) for frame in people_meshes.load(name).walk for visual in frame]


def test_several_processes_make_the_files_at_once(tmp_path, monkeypatch):
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        paths = pool.starmap(_load, [(tmp_path, NAMES[0])] * 3)
    assert paths[0] == paths[1] == paths[2]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    person = people_meshes.load(NAMES[0])
    body = people_meshes.read(NAMES[0])
    assert len(list((tmp_path / "xtdrone" / "people").iterdir())) == 1
    assert person.posture(-1.0) == person.standing
    assert person.posture(2.51) == person.walk[len(person.walk) // 2]
    for i, frame in enumerate((person.standing, *person.walk)):
        assert frame[0].texture.is_file()
        text = frame[0].geometry.path.read_text()
        points = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("v ")], dtype=float)
        assert np.allclose(points, body.posture(i), atol=1e-4)
        assert text.count("\nf ") == len(body.triangles)
