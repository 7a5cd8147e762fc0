#!/usr/bin/env python3
"""False finds a minute: the detector looks along lanes of a search over scenes of the test split without people.

    flights.py --minutes 10
    flights.py --minutes 10 --weights RUN/last.weights --keep FOLDER    # keeps the pictures with false boxes

Counts boxes a minute by threshold of probability; those that last: at the same place on the ground, within 2 m, in
three pictures in a row; and places that the search's rule would confirm from the boxes: five of them within 2 m with
log-odds of 8 in all. Runs in `./xtdrone shell`.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from evaluate import SETTINGS, detector_of
from make_data import REGION, Scene, View

from xtdrone_sim.poses import rotate
from xtdrone_sim.scenery import outdoor
from xtdrone_sim.visual import Pose

RATE = 2.0  # pictures a second
SPEED = 4.0  # m/s
LANE = 14.0  # m between lanes
THRESHOLDS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
SAME = 2.0  # m
HITS, LOG_ODDS = 5, 8.0  # confirm_hits and confirm_log_odds of the search

Find = tuple[float, float, float]
"""x, y on the ground, m, and probability."""


def lanes(height: float, pitch: float) -> list[View]:
    """Return the views of a search of the region, to and fro along x."""
    x0, y0, x1, y1 = REGION
    views = []
    forth = True
    for y in np.arange(y0 + LANE / 2, y1, LANE):
        places = np.arange(x0, x1, SPEED / RATE)
        for x in places if forth else places[::-1]:
            tilt = (0.0, math.radians(3.0))
            views.append(View((float(x), float(y), height), 0.0 if forth else math.pi, pitch, 0.0, tilt))
        forth = not forth
    return views


def on_ground(pose: Pose, pinhole: Any, u: float, v: float) -> tuple[float, float] | None:
    """Return where a pixel's ray meets the ground, m; None above the horizon."""
    ray = rotate(pose.orientation, tuple(pinhole.rays(np.array([[u, v]]))[0]))
    if ray[2] > -1e-3:
        return None
    way = -pose.position[2] / ray[2]
    return pose.position[0] + way * ray[0], pose.position[1] + way * ray[1]


def fly(seed: int, options: argparse.Namespace) -> list[list[Find]]:
    """Return what is found in each picture of a search over a scene."""
    world = outdoor(seed, region=REGION, persons=0, split="test", light="any")
    scene = Scene(world, options.backend)
    detector = detector_of(options.settings, options.weights, min(THRESHOLDS))
    found: list[list[Find]] = []
    for index, view in enumerate(lanes(options.height, -math.radians(options.pitch))):
        picture = scene.draw(view, labels=False)
        pose, places = scene.pose(view), []
        hits = detector.detect(picture.rgb)
        for hit in hits:
            place = on_ground(pose, scene.camera.pinhole, 0.5 * (hit.xmin + hit.xmax), hit.ymax)
            places.append((*(place or (math.inf, math.inf)), hit.probability))
        found.append(places)
        if options.keep and hits:
            _keep(options.keep / f"{seed}_{index:03d}.png", picture.rgb, hits)
    scene.renderer.close()
    return found


def _keep(path: Path, rgb: Any, hits: list[Any]) -> None:
    image = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    for hit in hits:
        corners = [round(v) for v in (hit.xmin, hit.ymin, hit.xmax, hit.ymax)]
        cv2.rectangle(image, (corners[0] - 3, corners[1] - 3), (corners[2] + 3, corners[3] + 3), (0, 0, 255), 1)
        place = (corners[0], max(corners[1] - 6, 10))
        cv2.putText(image, f"{hit.probability:.2f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 255), 1)
    cv2.imwrite(str(path), image)


def lasting(pictures: list[list[Find]], threshold: float) -> int:
    """Return how many finds are at the same place in three pictures in a row, each counted once."""
    count, runs = 0, []
    for picture in pictures:
        now = []
        for x, y, probability in picture:
            if probability < threshold or not math.isfinite(x):
                continue
            before = [length for a, b, length in runs if math.hypot(x - a, y - b) <= SAME]
            length = 1 + max(before, default=0)
            count += length == 3
            now.append((x, y, length))
        runs = now
    return count


def confirmed(pictures: list[list[Find]], threshold: float) -> int:
    """Return how many places of a flight have boxes enough to be confirmed."""
    places: list[list[float]] = []  # x, y, log-odds, hits
    for x, y, probability in (find for picture in pictures for find in picture):
        if probability < threshold or not math.isfinite(x):
            continue
        odds = math.log(probability / (1.0 - probability))
        near = [place for place in places if math.hypot(x - place[0], y - place[1]) <= SAME]
        if near:
            near[0][2] += odds
            near[0][3] += 1
        else:
            places.append([x, y, odds, 1])
    return sum(place[3] >= HITS and place[2] >= LOG_ODDS for place in places)


def main() -> None:
    """Fly, and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="of search (%(default)s)")
    parser.add_argument("--height", type=float, default=12.0, help="m (%(default)s)")
    parser.add_argument("--pitch", type=float, default=60.0, help="degrees down (%(default)s)")
    parser.add_argument("--seed", type=int, default=900_000, help="of the first scene (%(default)s)")
    parser.add_argument("--settings", type=Path, default=SETTINGS)
    parser.add_argument("--weights", type=Path, help="in place of the settings' ones")
    parser.add_argument("--keep", type=Path, help="folder for pictures with false boxes")
    parser.add_argument("--out", type=Path, help="JSON to write")
    parser.add_argument("--backend", default="auto")
    options = parser.parse_args()
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    flights: list[list[list[Find]]] = []
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        while sum(map(len, flights)) < options.minutes * 60 * RATE:
            flights.append(pool.apply(fly, (options.seed + len(flights), options)))
            print(f"{sum(map(len, flights))} pictures of {len(flights)} scenes", flush=True)
    minutes = sum(map(len, flights)) / RATE / 60
    rows = {}
    print(f"\n{minutes:.1f} minutes of search without people\n")
    print("| probability | false boxes | a minute | lasting ones | a minute | confirmed | a minute |")
    print("|---|---|---|---|---|---|---|")
    for threshold in THRESHOLDS:
        boxes = sum(probability >= threshold for flight in flights for picture in flight for *_, probability in picture)
        last = sum(lasting(flight, threshold) for flight in flights)
        sure = sum(confirmed(flight, threshold) for flight in flights)
        rows[str(threshold)] = {"boxes": boxes, "lasting": last, "confirmed": sure}
        counts = " | ".join(f"{count} | {count / minutes:.2f}" for count in (boxes, last, sure))
        print(f"| {threshold:g} | {counts} |")
    if options.out:
        options.out.write_text(json.dumps({"minutes": minutes, "thresholds": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
