"""Kernels that make range images of a lidar's points, and rays of range images."""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel

_SURE = 0.49  # columns off the middle of a column up to which a point is surely in it


@kernel
def fill_image(x, y, z, times, rings, between, all_directions, image, directions, all_times):
    """Fill a range image with the points of a turn.

    Of several points in a pixel the last one counts. Pixels without a point get no range, their plane's and column's
    direction, and a time as if columns followed each other evenly until the last point.

    Args:
        x, y, z: (n,) m, in the lidar's frame.
        times: (n,) s after the stamp.
        rings: (n,) row of each point; those of rows that are not there are left out.
        between: nearest and farthest range of points that are used, m.
        all_directions: (rows, columns, 3) unit vectors.
        image: (rows, columns) filled, m; NaN without a return.
        directions: (rows, columns, 3) filled.
        all_times: (rows, columns) filled, s.
    """
    rows, columns = image.shape
    image[:] = math.nan
    last, column = -math.inf, 0
    most = math.tan(_SURE * 2.0 * math.pi / columns)
    for n in range(len(x)):
        range_ = math.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        is_used = between[0] <= range_ <= between[1] and math.isfinite(times[n])
        if not (is_used and 0 <= rings[n] < rows):
            continue
        row = rings[n]
        column = _column(x[n], y[n], all_directions[0], most, column)
        image[row, column] = range_
        directions[row, column, 0] = x[n] / range_
        directions[row, column, 1] = y[n] / range_
        directions[row, column, 2] = z[n] / range_
        all_times[row, column] = times[n]
        last = max(last, times[n])
    spacing = (last if last > -math.inf else 0.0) / max(columns - 1, 1)
    for column in range(columns):
        for row in range(rows):
            if math.isnan(image[row, column]):
                directions[row, column] = all_directions[row, column]
                all_times[row, column] = column * spacing


@kernel
def _column(x, y, directions, most, guess):
    """Return the column whose azimuth is nearest to that of a point.

    Args:
        x, y: of the point, m.
        directions: (columns, 3) of any row, the first one backwards.
        most: tangent of the angle to a column's middle up to which a point is surely in it.
        guess: a column that it may well be in, or in the next one, as points come in the order in which a lidar turns;
            this saves an arcus tangens.
    """
    columns = len(directions)
    for near in (guess, (guess + 1) % columns):
        u, v = directions[near, 0], directions[near, 1]
        if abs(u * y - v * x) < most * (u * x + v * y):
            return near
    turn = (math.atan2(y, x) + math.pi) / (2.0 * math.pi)
    return int(np.rint(turn * columns)) % columns


@kernel
def take_rays(
    image, all_directions, all_times, farthest, is_round, is_ordered, by_columns, ranges, directions, times, hits
):
    """Select the rays of a range image that carry information; return their number n. See ``RangeImage``.

    Args:
        image: (rows, columns) m, not finite without a return.
        all_directions, all_times: (rows, columns, 3) and (rows, columns) of all pixels.
        farthest: range of rays without a return, m.
        is_round, is_ordered, by_columns: see ``RangeImage``.
        ranges, directions, times, hits: (rows * columns,) and (rows * columns, 3) of which the first n are filled.
    """
    rows, columns = image.shape
    count = 0
    for place in range(rows * columns):
        row, column = (place % rows, place // rows) if by_columns else (place // columns, place % columns)
        hit = math.isfinite(image[row, column])
        if not hit and not (is_ordered and _is_empty(image, row, column, is_round)):
            continue
        ranges[count] = image[row, column] if hit else farthest
        for axis in range(3):
            directions[count, axis] = all_directions[row, column, axis]
        times[count], hits[count] = all_times[row, column], hit
        count += 1
    return count


@kernel
def _is_empty(image, row, column, is_round):
    """Return whether none of a pixel's four neighbours has a return; at an edge it is its own neighbour."""
    rows, columns = image.shape
    left = (column - 1) % columns if is_round else max(column - 1, 0)
    right = (column + 1) % columns if is_round else min(column + 1, columns - 1)
    below, above = max(row - 1, 0), min(row + 1, rows - 1)
    beside = math.isfinite(image[row, left]) or math.isfinite(image[row, right])
    return not (beside or math.isfinite(image[below, column]) or math.isfinite(image[above, column]))
