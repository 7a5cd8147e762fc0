"""Fusion of heights of all sources, and the barometer (PX4: height_control, baro_height_control).

EKF2_HGT_REF selects the height reference. Every other height source tracks the reference with an estimated offset and
replaces it, keeping that offset, when the reference times out.
"""

from __future__ import annotations

from xtdrone_autopilot.estimator.aiding.source_timeouts import AIDING_US, HEIGHT_RESET_US, is_recent
from xtdrone_autopilot.estimator.fusion import POS, fuse_state, reset_height
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import HEIGHT_BARO
from xtdrone_common.rotation_kernels import constrain

_BARO_START_US = 1_000_000  # time for which the barometer waits for the height reference

OFFSET_GAIN = 0.02  # share of each innovation added to a source's offset


@kernel
def fuse_height(e, s, p, source, down, variance, gate, work):
    """Fuse a height, or start fusing its source.

    Args:
        e, s, p: the vehicle's records.
        source: ``HEIGHT_*``.
        down: measured down coordinate without the source's offset, m.
        variance: m^2.
        gate: innovation gate, standard deviations.
        work: (2, N_STATES) scratch.

    Returns:
        The innovation test ratio; 0 on a start.
    """
    is_reference = int(p.ekf2_hgt_ref) == source
    now = s.time_us
    if not e.height_used[source]:
        e.height_used[source] = 1
        e.time_height_fuse_us[source] = now
        if is_reference and source != HEIGHT_BARO:
            e.height_offset[source] = 0.0
            reset_height(e, down, variance)
        else:
            e.height_offset[source] = e.position[2] - down
            if not e.altitude_valid:
                reset_height(e, e.position[2], variance)
        e.altitude_valid = 1
        e.time_last_hgt_fuse_us = now
        return 0.0
    innovation = down + e.height_offset[source] - e.position[2]
    ratio = fuse_state(e, POS + 2, innovation, variance, gate, work)
    e.test_ratio.hgt = ratio
    e.innovation.hgt = innovation
    reference = int(p.ekf2_hgt_ref)
    known = 0 <= reference < len(e.height_used)  # a parameter may be out of range
    if (
        known
        and not is_reference
        and e.height_used[reference]
        and is_recent(now, e.time_height_fuse_us[reference], AIDING_US)
    ):
        e.height_offset[source] -= OFFSET_GAIN * constrain(innovation, -1.0, 1.0)
    if ratio <= 1.0:
        e.time_height_fuse_us[source] = e.time_last_hgt_fuse_us = now
    elif now - e.time_height_fuse_us[source] > HEIGHT_RESET_US:
        if is_reference or now - e.time_last_hgt_fuse_us > HEIGHT_RESET_US:
            reset_height(e, down + e.height_offset[source], variance)
            e.time_last_hgt_fuse_us = now
        else:
            e.height_offset[source] = e.position[2] - down
        e.time_height_fuse_us[source] = now
    return ratio


@kernel
def process_baro(e, s, p, work):
    """Process a pressure altitude."""
    e.time_baro_us = s.time_us
    if not int(p.ekf2_baro_ctrl):
        e.height_used[HEIGHT_BARO] = 0
        return
    is_reference = int(p.ekf2_hgt_ref) == HEIGHT_BARO
    # wait for the height reference, which would otherwise reset the height
    if not e.altitude_valid and not is_reference and s.time_us - e.time_aligned_us < _BARO_START_US:
        return
    down = e.origin.alt - s.baro_alt + e.velocity[2] * p.ekf2_baro_delay * 1e-3
    e.test_ratio.baro = fuse_height(e, s, p, HEIGHT_BARO, down, p.ekf2_baro_noise**2, p.ekf2_baro_gate, work)
