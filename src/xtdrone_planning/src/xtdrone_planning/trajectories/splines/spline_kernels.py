"""Kernels on uniform cubic B-splines: values, maximum speed and acceleration."""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel

_HALVINGS = 50


@kernel
def spline_at(points, interval, since):
    """Return position, velocity and acceleration (3, 3) at ``since`` s after the start, which must be within."""
    segment = min(int(since / interval), len(points) - 4)
    u = since / interval - segment
    state = np.zeros((3, 3))
    basis = (
        ((1 - u) ** 3 / 6, (3 * u**3 - 6 * u**2 + 4) / 6, (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6, u**3 / 6),
        (-((1 - u) ** 2) / 2, (3 * u**2 - 4 * u) / 2, (-3 * u**2 + 2 * u + 1) / 2, u**2 / 2),
        (1 - u, 3 * u - 2, 1 - 3 * u, u),
    )
    for c in range(3):
        for n in range(4):
            q = points[segment + n, c]
            state[0, c] += basis[0][n] * q
            state[1, c] += basis[1][n] * q / interval
            state[2, c] += basis[2][n] * q / (interval * interval)
    return state


@kernel
def greatest_acceleration(points, interval):
    """Return the maximum acceleration, m/s^2: it is linear between knots, so its norm is largest at one of them."""
    most = 0.0
    for k in range(len(points) - 2):
        square = 0.0
        for c in range(3):
            square += (points[k, c] - 2.0 * points[k + 1, c] + points[k + 2, c]) ** 2
        most = max(most, square)
    return math.sqrt(most) / (interval * interval)


@kernel
def greatest_speed(points, interval):
    """Return the maximum speed, m/s.

    The maximum lies at a knot, or where velocity and acceleration are orthogonal: at a root of a cubic polynomial,
    whose roots are separated by its extrema.
    """
    most = 0.0
    cubic, bounds = np.empty(4), np.empty(4)
    for k in range(len(points) - 3):
        cubic[:] = 0.0
        for c in range(3):
            a, b, d = (
                points[k + 1, c] - points[k, c],
                points[k + 2, c] - points[k + 1, c],
                points[k + 3, c] - points[k + 2, c],
            )
            # velocity (a (1-u)^2 + b (1 + 2u - 2u^2) + d u^2) / 2 = p u^2 + q u + r, in voxels of the interval
            p, q, r = 0.5 * (a - 2.0 * b + d), b - a, 0.5 * (a + b)
            cubic[3] += 2.0 * p * p
            cubic[2] += 3.0 * p * q
            cubic[1] += q * q + 2.0 * p * r
            cubic[0] += q * r
        most = max(most, _speed_square(points, k, 0.0), _speed_square(points, k, 1.0))
        count = _monotone_parts(cubic, bounds)
        for n in range(count):
            low, high = bounds[n], bounds[n + 1]
            if _value(cubic, low) > 0.0 and _value(cubic, high) < 0.0:  # a maximum speed, not a minimum one
                for _ in range(_HALVINGS):
                    middle = 0.5 * (low + high)
                    if _value(cubic, middle) > 0.0:
                        low = middle
                    else:
                        high = middle
                most = max(most, _speed_square(points, k, low))
    return math.sqrt(most) / interval


@kernel
def extremes(points, axis):
    """Return the minimum and maximum coordinate of a spline along an axis, m: at a knot or at an extremum."""
    least, most = math.inf, -math.inf
    for k in range(len(points) - 3):
        a, b, c, d = points[k, axis], points[k + 1, axis], points[k + 2, axis], points[k + 3, axis]
        if min(a, b, c, d) >= least and max(a, b, c, d) <= most:
            continue  # the segment is in the hull of its control points
        # position ((d - 3c + 3b - a) u^3 + 3 (a - 2b + c) u^2 + 3 (c - a) u + a + 4b + c) / 6
        cubic, square, line = (d - 3.0 * c + 3.0 * b - a) / 6.0, 0.5 * (a - 2.0 * b + c), 0.5 * (c - a)
        flat = (a + 4.0 * b + c) / 6.0
        places = np.array([0.0, 1.0, 0.0, 0.0])
        root = square * square - 3.0 * cubic * line
        if root > 0.0:
            # the roots of 3 cubic u^2 + 2 square u + line, without a division by a small number
            q = -(square + math.copysign(math.sqrt(root), square))
            places[2] = min(1.0, max(0.0, q / (3.0 * cubic))) if cubic != 0.0 else 0.0
            places[3] = min(1.0, max(0.0, line / q)) if q != 0.0 else 0.0
        for u in places:
            value = ((cubic * u + square) * u + line) * u + flat
            least, most = min(least, value), max(most, value)
    return least, most


@kernel
def _value(cubic, u):
    return ((cubic[3] * u + cubic[2]) * u + cubic[1]) * u + cubic[0]


@kernel
def _monotone_parts(cubic, bounds):
    """Write the bounds of the intervals of [0, 1] in which a cubic is monotonic; return their number."""
    bounds[0] = 0.0
    count = 1
    a, b, c = 3.0 * cubic[3], 2.0 * cubic[2], cubic[1]
    root = b * b - 4.0 * a * c
    if root >= 0.0 and a != 0.0:
        root = math.sqrt(root)
        first, second = (-b - root) / (2.0 * a), (-b + root) / (2.0 * a)
        for u in (min(first, second), max(first, second)):
            if bounds[count - 1] < u < 1.0:
                bounds[count] = u
                count += 1
    elif a == 0.0 and b != 0.0 and 0.0 < -c / b < 1.0:
        bounds[count] = -c / b
        count += 1
    bounds[count] = 1.0
    return count


@kernel
def _speed_square(points, k, u):
    """Return the square of the speed in segment ``k``, in m per interval."""
    square = 0.0
    for c in range(3):
        v = (
            -((1.0 - u) ** 2) * points[k, c]
            + (3.0 * u * u - 4.0 * u) * points[k + 1, c]
            + (-3.0 * u * u + 2.0 * u + 1.0) * points[k + 2, c]
            + u * u * points[k + 3, c]
        )
        square += 0.25 * v * v
    return square
