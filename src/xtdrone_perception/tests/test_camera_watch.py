"""Faults of a camera."""

from __future__ import annotations

import pytest

from xtdrone_perception.detection.yolo_node import CameraWatch


def watched(steps, picture):
    """Return the faults after each of ``steps`` seconds of flight at 1 m/s; ``picture(t)``: stamp, content or None."""
    watch, faults = CameraWatch(), []
    for k in range(steps):
        t = 0.5 * k
        shown = picture(t)
        if shown is not None:
            watch.on_picture(t, *shown, (t, 0.0, 20.0))
        watch.update(t, flying=True)
        faults.append(watch.fault)
    return faults


def test_a_camera_that_works_has_no_fault():
    assert set(watched(40, lambda t: (t, int(2 * t)))) == {""}


def test_silence_old_stamps_and_pictures_that_never_change_are_faults():
    for failed in (lambda t: None, lambda t: (5.0, 99)):
        faults = watched(40, lambda t, failed=failed: (t, int(2 * t)) if t < 5.0 or t >= 15.0 else failed(t))
        first = next(k for k, fault in enumerate(faults) if fault)
        assert 0.5 * first == pytest.approx(8.0, abs=0.5)
        assert "no image for more than 3 s" in faults[first]
        assert faults[30:] == [""] * 10
    faults = watched(40, lambda t: (t, int(2 * min(t, 5.0)) if t < 15.0 else int(2 * t)))
    first = next(k for k, fault in enumerate(faults) if fault)
    assert 0.5 * first == pytest.approx(8.5)  # more than 3 m since 5 s
    assert faults[29] == "its images have been the same since 5.0 s, in flight"
    assert faults[30:] == [""] * 10


def test_on_the_ground_a_camera_may_be_silent():
    watch = CameraWatch()
    for k in range(20):
        watch.update(0.5 * k, flying=False)
    assert (watch.fault, watch.seen) == ("", False)
    for k in range(20, 26):
        watch.update(0.5 * k, flying=True)
        assert watch.fault == ""
    watch.update(13.0, flying=True)
    assert watch.fault
