"""Kernels of the optimisation of a spline's control points.

The cost is that of X. Zhou et al., EGO-Planner: an ESDF-free gradient-based local planner for quadrotors, RA-L 6, 2021,
smoothness, collision and feasibility, with the gradient of a distance field as in V. Usenko et al., IROS 2017. It is
minimised by L-BFGS (J. Nocedal, Mathematics of Computation 35, 1980) with a backtracking line search.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel
from xtdrone_planning.mapping.field_lookup import distance_at

FIXED = 3
"""Control points at either end that are determined by the boundary states."""

_JERK, _LIMIT, _NEAR_PATH = 0.02, 4.0, 0.15  # weights
SAMPLES = 3
"""Sampling points per segment for the distance to obstacles and other vehicles."""
_MEMORY = 6
_SAME_PLACE = 1e-6  # m: closer than this, the direction from another vehicle is undefined
UPRIGHT = 0.5
"""Scale of heights in distances from others, so that vehicles pass beside each other rather than through downwash and
at heights that no sensor has seen; the ellipsoid of X. Zhou et al., EGO-Swarm, ICRA 2021."""
_ARMIJO = 1e-4


@kernel
def cost(
    points, interval, reference, distance, corner, resolution, clearance, weight, speed, acceleration, moving, apart,
    gradient,
):  # fmt: skip
    """Return the cost of a spline, and its derivatives.

    Args:
        points: (n, 3) control points, m.
        interval: s between knots.
        reference: (n, 3) positions that weakly attract the control points, m.
        distance, corner, resolution: of the map.
        clearance: distance to obstacles below which cost is added, m.
        weight: Weight of that cost.
        speed, acceleration: limits, m/s and m/s^2.
        moving: ((n - 3) * SAMPLES, m, 3) positions of m other vehicles at the sample times, m.
        apart: (m,) distance from each of them below which cost is added, m.
        gradient: (n, 3), the result.
    """
    n = len(points)
    gradient[:] = 0.0
    total = 0.0
    jerk_weight = _JERK / interval**5
    for k in range(n - 3):
        for c in range(3):
            jerk = points[k + 3, c] - 3.0 * points[k + 2, c] + 3.0 * points[k + 1, c] - points[k, c]
            total += jerk_weight * jerk * jerk
            slope = 2.0 * jerk_weight * jerk
            gradient[k, c] -= slope
            gradient[k + 1, c] += 3.0 * slope
            gradient[k + 2, c] -= 3.0 * slope
            gradient[k + 3, c] += slope
        total += _collision(
            points, k, interval, distance, corner, resolution, clearance, weight, moving, apart, gradient
        )
    total += _limits(points, interval, speed, acceleration, gradient)
    for k in range(n):
        for c in range(3):
            off = points[k, c] - reference[k, c]
            total += interval * _NEAR_PATH * off * off
            gradient[k, c] += 2.0 * interval * _NEAR_PATH * off
    return total


@kernel
def _collision(points, k, interval, distance, corner, resolution, clearance, weight, moving, apart, gradient):
    """Return the cost of segment ``k`` near obstacles and others, and add its derivatives."""
    total = 0.0
    scale = interval / SAMPLES * weight
    for sample in range(SAMPLES):
        u = sample / SAMPLES
        b0, b1 = (1 - u) ** 3 / 6, (3 * u**3 - 6 * u**2 + 4) / 6
        b2, b3 = (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6, u**3 / 6
        x = b0 * points[k, 0] + b1 * points[k + 1, 0] + b2 * points[k + 2, 0] + b3 * points[k + 3, 0]
        y = b0 * points[k, 1] + b1 * points[k + 1, 1] + b2 * points[k + 2, 1] + b3 * points[k + 3, 1]
        z = b0 * points[k, 2] + b1 * points[k + 1, 2] + b2 * points[k + 2, 2] + b3 * points[k + 3, 2]
        away, gx, gy, gz = distance_at(distance, corner, resolution, x, y, z)
        lack = clearance - away
        if lack > 0.0:
            total += scale * lack * lack
            slope = -2.0 * scale * lack
            for m, b in ((0, b0), (1, b1), (2, b2), (3, b3)):
                gradient[k + m, 0] += slope * b * gx
                gradient[k + m, 1] += slope * b * gy
                gradient[k + m, 2] += slope * b * gz
        for j in range(len(apart)):
            other = moving[SAMPLES * k + sample, j]
            ox, oy, oz = x - other[0], y - other[1], UPRIGHT * (z - other[2])
            off = math.sqrt(ox * ox + oy * oy + oz * oz)
            lack = apart[j] - off
            if lack <= 0.0 or off < _SAME_PLACE:
                continue
            total += scale * lack * lack
            slope = -2.0 * scale * lack / off
            for m, b in ((0, b0), (1, b1), (2, b2), (3, b3)):
                gradient[k + m, 0] += slope * b * ox
                gradient[k + m, 1] += slope * b * oy
                gradient[k + m, 2] += slope * b * UPRIGHT * oz
    return total


@kernel
def _limits(points, interval, speed, acceleration, gradient):
    """Return the cost of exceeding the velocity and acceleration limits, and add its derivatives."""
    total = 0.0
    n = len(points)
    for k in range(n - 1):
        u, v, w = points[k + 1] - points[k]
        excess = (u * u + v * v + w * w) / (interval * interval) / (speed * speed) - 1.0
        if excess > 0.0:
            total += interval * _LIMIT * 10.0 * excess * excess
            slope = 4.0 * interval * _LIMIT * 10.0 * excess / (interval * interval) / (speed * speed)
            for c, d in ((0, u), (1, v), (2, w)):
                gradient[k, c] -= slope * d
                gradient[k + 1, c] += slope * d
    for k in range(n - 2):
        u, v, w = points[k + 2] - 2.0 * points[k + 1] + points[k]
        factor = 1.0 / (interval**4 * acceleration * acceleration)
        excess = (u * u + v * v + w * w) * factor - 1.0
        if excess > 0.0:
            total += interval * _LIMIT * excess * excess
            slope = 4.0 * interval * _LIMIT * excess * factor
            for c, d in ((0, u), (1, v), (2, w)):
                gradient[k, c] += slope * d
                gradient[k + 1, c] -= 2.0 * slope * d
                gradient[k + 2, c] += slope * d
    return total


@kernel
def optimise(
    points, interval, reference, distance, corner, resolution, clearance, weight, speed, acceleration, moving, apart,
    iterations,
):  # fmt: skip
    """Minimise the cost over the free control points, in place; see ``cost``. Return the cost."""
    free = points[FIXED:-FIXED].size
    old_steps, old_slopes = np.zeros((_MEMORY, free)), np.zeros((_MEMORY, free))
    shares, curvatures = np.zeros(_MEMORY), np.zeros(_MEMORY)
    gradient, trial = np.zeros_like(points), points.copy()
    value = cost(
        points, interval, reference, distance, corner, resolution, clearance, weight, speed, acceleration, moving,
        apart, gradient,
    )  # fmt: skip
    slope = gradient[FIXED:-FIXED].copy().reshape(-1)
    kept = 0
    for _ in range(iterations):
        step = _direction(slope, old_steps, old_slopes, shares, curvatures, kept)
        fall = _dot(step, slope)
        if fall > -1e-12:
            break
        size = 1.0 if kept > 0 else min(1.0, 0.2 / math.sqrt(_dot(step, step)))
        accepted = False
        for _ in range(20):
            trial[FIXED:-FIXED] = points[FIXED:-FIXED] + (size * step).reshape(-1, 3)
            new = cost(
                trial, interval, reference, distance, corner, resolution, clearance, weight, speed, acceleration,
                moving, apart, gradient,
            )  # fmt: skip
            if new <= value + _ARMIJO * size * fall:
                accepted = True
                break
            size *= 0.5
        if not accepted:
            break
        new_slope = gradient[FIXED:-FIXED].copy().reshape(-1)
        change = new_slope - slope
        curvature = size * _dot(step, change)
        if curvature > 1e-12:
            place = kept % _MEMORY
            old_steps[place], old_slopes[place], curvatures[place] = size * step, change, curvature
            kept += 1
        points[FIXED:-FIXED] = trial[FIXED:-FIXED]
        slope = new_slope
        small = value - new < 1e-4 * abs(value)
        value = new
        if small:
            break
    return value


@kernel
def _dot(a, b):
    """Return the scalar product, summed in a fixed order: that of BLAS depends on the machine."""
    total = 0.0
    for n in range(len(a)):
        total += a[n] * b[n]
    return total


@kernel
def _direction(slope, steps, changes, shares, curvatures, kept):
    """Return the step by the two-loop recursion of L-BFGS."""
    step = -slope
    count = min(kept, _MEMORY)
    for back in range(count):
        m = (kept - 1 - back) % _MEMORY
        shares[m] = _dot(steps[m], step) / curvatures[m]
        step -= shares[m] * changes[m]
    if count > 0:
        m = (kept - 1) % _MEMORY
        step *= curvatures[m] / _dot(changes[m], changes[m])
    for forward in range(count - 1, -1, -1):
        m = (kept - 1 - forward) % _MEMORY
        share = _dot(changes[m], step) / curvatures[m]
        step += (shares[m] - share) * steps[m]
    return step
