"""Merging of several vehicles' maps: starting from the first, each further map joins by the best link (Dijkstra)."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import small_gicp
from numpy.typing import NDArray

from xtdrone_common.pose_matrices import transform_points
from xtdrone_planning.merging.frame_links import Link, Pairs, link_of
from xtdrone_planning.merging.map_registration import Fit, Surfaces, fit_of, surfaces_of
from xtdrone_planning.merging.settings import FitSettings, LinkSettings, NotMergedError

Array = NDArray[np.float64]


class Placed(NamedTuple):
    """Placement of a vehicle's map in the merged one.

    Attributes:
        pose: (4, 4) in the first vehicle's map.
        through: index of the vehicle whose map it is linked with; its own for the first.
        fit: registration with that map; None: linked by relative estimates alone.
        deviation: m, standard deviation of its position from the relative estimates along the chain.
    """

    pose: Array
    through: int
    fit: Fit | None
    deviation: float


class Merged(NamedTuple):
    """Result of merging.

    Attributes:
        placed: vehicles in the merged map, by index.
        reasons: for each vehicle not merged, by index: the vehicles in the merged map with which a link was tried, and
            why each failed; empty: there are no estimates with any of them.
    """

    placed: dict[int, Placed]
    reasons: dict[int, dict[int, str]]


def merge_maps(
    clouds: Sequence[Array], pairs: Mapping[tuple[int, int], Pairs], link_how: LinkSettings, fit_how: FitSettings
) -> Merged:
    """Return the placements of all vehicles' maps in the first one's.

    Args:
        clouds: (n, 3) m, points of each vehicle's map, in its frame.
        pairs: estimates by observer and other vehicle.
        link_how: settings of the relative poses.
        fit_how: settings of the registration.
    """
    links, refused = _links(pairs, link_how)
    surfaces = [surfaces_of(cloud, fit_how) if fit_how.refine != "off" else None for cloud in clouds]
    placed = {0: Placed(np.eye(4), 0, None, 0.0)}
    waiting: list[tuple[float, int, int]] = []  # deviation squared, merged vehicle, next one
    _reach_out(0, placed, links, waiting)
    while waiting:
        square, known, number = heapq.heappop(waiting)
        if number in placed:
            continue
        link = links[known, number]
        try:
            fit = _fit(surfaces[known], surfaces[number], link, fit_how)
        except NotMergedError as error:
            refused[known, number] = str(error)
            continue
        pose = placed[known].pose @ (link.pose if fit is None else fit.pose)
        placed[number] = Placed(pose, known, fit, float(np.sqrt(square)))
        _reach_out(number, placed, links, waiting)
    others = [number for number in range(len(clouds)) if number not in placed]
    return Merged(placed, {number: _reasons(number, placed, refused) for number in others})


def merge_points(clouds: Sequence[Array], placed: Mapping[int, Placed], voxel: float) -> Array:
    """Return the merged map, (n, 3) m in the first vehicle's frame: the mean of the points in each cell.

    Args:
        clouds: (n, 3) m, points of each vehicle's map, in its frame.
        placed: their placements.
        voxel: side of a cell, m.
    """
    parts = [transform_points(placed[number].pose, clouds[number]) for number in sorted(placed)]
    points = np.concatenate(parts)
    return np.asarray(small_gicp.voxelgrid_sampling(points, voxel).points())[:, :3] if len(points) else points


def _links(
    pairs: Mapping[tuple[int, int], Pairs], settings: LinkSettings
) -> tuple[dict[tuple[int, int], Link], dict[tuple[int, int], str]]:
    """Return the links in both directions, each by the better of the two estimates, and the reasons for missing
    links."""
    links: dict[tuple[int, int], Link] = {}
    refused: dict[tuple[int, int], str] = {}
    for ends in sorted(pairs):
        try:
            link = link_of(pairs[ends], settings)
        except NotMergedError as error:
            refused[ends] = str(error)
            continue
        if ends not in links or link.deviation < links[ends].deviation:
            links[ends], links[ends[::-1]] = link, link.reversed()
    return links, refused


def _reach_out(
    known: int,
    placed: Mapping[int, Placed],
    links: Mapping[tuple[int, int], Link],
    waiting: list[tuple[float, int, int]],
) -> None:
    """Add the links of a merged vehicle to those to be tried."""
    for first, number in sorted(links):
        if first == known and number not in placed:
            square = placed[known].deviation ** 2 + links[first, number].deviation ** 2
            heapq.heappush(waiting, (square, known, number))


def _fit(first: Surfaces | None, second: Surfaces | None, link: Link, settings: FitSettings) -> Fit | None:
    if settings.refine == "off":
        return None
    try:
        return fit_of(first, second, link, settings)
    except NotMergedError:
        if settings.refine == "required":
            raise
        return None


def _reasons(number: int, placed: Mapping[int, Placed], refused: Mapping[tuple[int, int], str]) -> dict[int, str]:
    """Return, for each merged vehicle, why there is no link with it."""
    found = {known: refused.get((known, number)) or refused.get((number, known)) for known in sorted(placed)}
    return {known: text for known, text in found.items() if text}
