#!/usr/bin/env python3
"""False finds per minute: runs the detector along the lanes of a search over scenes of the test split.

    flights.py --minutes 30
    flights.py --minutes 30 --weights RUN/last.weights --keep FOLDER    # keeps the images with false boxes

Counts the boxes per minute that show no person, by threshold of probability, and the results of the search by its
rule and settings: candidates, second looks on a circle (two images per second), false finds and people found.
Vehicles,
wind and tracks are not simulated: poses are exact, and finds within ``same_place`` are one. Runs in `./xtdrone shell`.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from evaluate import SETTINGS, detector_of
from make_data import REGION, Scene, View, people_of

from xtdrone_common.poses import Pose, rotate
from xtdrone_common.rotation import from_euler
from xtdrone_coordination.search.people.candidates import Candidate, Evidence, Sighting, nearest
from xtdrone_coordination.search.search_settings import MissionSettings
from xtdrone_worlds.shapes.visual import Mesh, Visual
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.scenery import FreeGround, outdoor
from xtdrone_worlds.worlds.sdf import SdfWorld

RATE = 2.0  # images per second
SPEED = 4.0  # m/s
LANE = 14.0  # m between lanes
THRESHOLDS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
RIGHT = 2.0  # m, maximum distance of a correct find from a person
FREE = 0.5  # m, free radius around a person
CAMERA = "camera"

Place = tuple[float, float]
"""x, y on the ground, m."""


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
    """Return the intersection of a pixel's ray with the ground, m; None above the horizon."""
    ray = rotate(pose.orientation, tuple(pinhole.rays(np.array([[u, v]]))[0]))
    if ray[2] > -1e-3:
        return None
    way = -pose.position[2] / ray[2]
    return pose.position[0] + way * ray[0], pose.position[1] + way * ray[1]


def put_people(scene: Scene, seed: int, count: int, folder: Path, options: argparse.Namespace) -> list[Place]:
    """Place people of the test split on free ground, walking or standing; return their positions, m."""
    random = np.random.default_rng((7, seed))
    ground, bodies = FreeGround(outdoor_world(seed)), people_of("test", options.people)
    x0, y0, x1, y1 = REGION
    places: list[Place] = []
    while len(places) < count:
        x, y = float(random.uniform(x0 + 5, x1 - 5)), float(random.uniform(y0 + 5, y1 - 5))
        if not ground.is_free(x, y, FREE) or any(math.dist((x, y), other) < 15.0 for other in places):
            continue
        _, body, texture = bodies[random.integers(len(bodies))]
        posture = 0 if random.random() < 0.35 else int(random.integers(1, len(body.poses)))
        file = folder / f"{len(places)}.obj"
        file.write_text(people_meshes.wavefront(body, posture))
        number = scene.renderer.add([Visual(Mesh(file), texture=texture)])
        scene.renderer.place(number, Pose((x, y, 0.0), from_euler(0.0, 0.0, random.uniform(-math.pi, math.pi))))
        places.append((x, y))
    return places


def outdoor_world(seed: int) -> SdfWorld:
    """Return a scene without people."""
    return outdoor(seed, region=REGION, persons=0, split="test", light="any")


class Flight:
    """A search over one scene.

    Attributes:
        boxes: probabilities of all boxes in images of the lanes that show no person.
        pictures: number of images.
        people: positions of the people, m.
        candidates: objects shown often enough in the images of the lanes.
        looks: (evidence, place, right) of each second look.
    """

    def __init__(self, seed: int, options: argparse.Namespace, folder: Path):
        self.options, self.settings = (
            options,
            MissionSettings(
                look_pitch=-options.look_pitch, look_arc=options.look_arc, candidate_probability=options.candidate
            ),
        )
        self.scene = Scene(outdoor_world(seed), options.backend)
        self.detector = detector_of(options.settings, options.weights, min(THRESHOLDS))
        self.people = put_people(self.scene, seed, options.persons, folder, options)
        self.boxes: list[float] = []
        self.pictures = 0
        self.candidates: list[Candidate] = []
        self.looks: list[tuple[Evidence, Place, bool]] = []
        self._name = str(seed)
        for view in lanes(options.height, -math.radians(options.pitch)):
            self._search(view)
        for candidate in self.candidates:
            hits = candidate.hits[CAMERA] >= self.settings.candidate_hits
            if hits and candidate.mean(CAMERA) >= self.settings.candidate_probability:
                evidence, place = self._look(candidate)
                self.looks.append((evidence, place, self._right(place)))
        self.scene.renderer.close()

    def _right(self, place: Place) -> bool:
        return any(math.dist(place, person) <= RIGHT for person in self.people)

    def _hits(self, view: View) -> list[tuple[float, Place]]:
        """Return probability and ground position of each detection from a view."""
        pose, found = self.scene.pose(view), []
        picture = self.scene.draw(view, labels=False)
        false = []
        for hit in self.detector.detect(picture.rgb):
            place = on_ground(pose, self.scene.camera.pinhole, 0.5 * (hit.xmin + hit.xmax), hit.ymax)
            if place is None:
                continue
            found.append((hit.probability, place))
            if not self._right(place):
                false.append(hit)
        if self.options.keep and false:
            _keep(self.options.keep / f"{self._name}_{self.pictures:03d}.png", picture.rgb, false)
        return found

    def _search(self, view: View) -> None:
        settings, time = self.settings, self.pictures / RATE
        self.pictures += 1
        for probability, place in self._hits(view):
            if not self._right(place):
                self.boxes.append(probability)
            if probability < self.options.confidence:
                continue
            candidate = nearest(self.candidates, place, time, settings.same_place)
            sighting = Sighting(0, place, probability=probability)
            if candidate is None:
                candidate = Candidate(place, (0.0, 0.0), sighting.covariance, time)
                self.candidates.append(candidate)
            candidate.see(CAMERA, time, sighting)

    def _look(self, candidate: Candidate) -> tuple[Evidence, Place]:
        """Fly a second look as ``search.mission`` does; return its evidence and its last position."""
        settings, options, evidence = self.settings, self.options, Evidence()
        height = settings.look_height
        radius = height / math.tan(math.radians(options.look_pitch))
        step = min(settings.look_speed / radius, 0.35) / RATE
        angle, place = 0.0, candidate.position
        for number in range(round(settings.look_time * RATE)):
            x, y = place[0] + radius * math.cos(angle), place[1] + radius * math.sin(angle)
            tilt = (0.0, math.radians(3.0))
            view = View((x, y, height), angle + math.pi, -math.radians(options.look_pitch), 0.0, tilt)
            near = [
                (math.dist(place, there), there, probability)
                for probability, there in self._hits(view)
                if probability >= options.confidence and math.dist(place, there) <= settings.same_place
            ]
            if near:
                evidence.hit(max(probability for _, _, probability in near))
                place = min(near)[1]
            else:
                evidence.miss()
            angle += step
            if evidence.log_odds <= settings.reject_log_odds:
                break
            if number * step >= math.radians(settings.look_arc) and evidence.log_odds >= settings.confirm_log_odds:
                break
        return evidence, place


def fly(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the results of a search over a scene."""
    with tempfile.TemporaryDirectory() as folder:
        flight = Flight(seed, options, Path(folder))
    settings = flight.settings
    return {
        "pictures": flight.pictures,
        "boxes": flight.boxes,
        "people": flight.people,
        "candidates": [
            {"place": c.position, "hits": c.hits[CAMERA], "mean": c.mean(CAMERA)}
            for c in flight.candidates
            if c.hits[CAMERA] >= settings.candidate_hits
        ],
        "looks": [
            {
                "place": place,
                "right": right,
                "pictures": evidence.pictures,
                "hits": evidence.hits,
                "mean": evidence.mean,
                "log_odds": evidence.log_odds,
                "sure": evidence.log_odds >= settings.confirm_log_odds and evidence.hits >= settings.confirm_hits,
            }
            for evidence, place, right in flight.looks
        ],
    }


def _keep(path: Path, rgb: Any, hits: list[Any]) -> None:
    image = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    for hit in hits:
        corners = [round(v) for v in (hit.xmin, hit.ymin, hit.xmax, hit.ymax)]
        cv2.rectangle(image, (corners[0] - 3, corners[1] - 3), (corners[2] + 3, corners[3] + 3), (0, 0, 255), 1)
        place = (corners[0], max(corners[1] - 6, 10))
        cv2.putText(image, f"{hit.probability:.2f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 255), 1)
    cv2.imwrite(str(path), image)


def found(flight: dict[str, Any], least: float) -> int:
    """Return the number of people found by looks with at least this mean probability."""
    places = [look["place"] for look in flight["looks"] if look["sure"] and look["mean"] >= least]
    return sum(any(math.dist(place, person) <= RIGHT for place in places) for person in flight["people"])


def print_tables(flights: list[dict[str, Any]]) -> None:
    """Print false boxes by threshold, and false and correct finds by required mean probability."""
    minutes = sum(flight["pictures"] for flight in flights) / RATE / 60
    people = sum(len(flight["people"]) for flight in flights)
    looks = [look for flight in flights for look in flight["looks"]]
    print(f"\n{minutes:.1f} minutes of search over {len(flights)} scenes with {people} people in total\n")
    print("| probability | false boxes per minute |\n|---|---|")
    for threshold in THRESHOLDS:
        boxes = sum(probability >= threshold for flight in flights for probability in flight["boxes"])
        print(f"| {threshold:g} | {boxes / minutes:.2f} |")
    wrong = [look for look in looks if not look["right"]]
    print(f"\n{len(looks)} second looks, {len(wrong)} of them without a person\n")
    print("| mean probability of the look | false finds | per minute | people found |\n|---|---|---|---|")
    for least in np.arange(0.50, 0.86, 0.05):
        false = sum(look["sure"] and look["mean"] >= least for look in wrong)
        right = sum(found(flight, least) for flight in flights)
        print(f"| {least:.2f} | {false} | {false / minutes:.3f} | {right} of {people} |")


def main() -> None:
    """Run the searches and count the finds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="minutes of search (%(default)s)")
    parser.add_argument("--height", type=float, default=12.0, help="height of the camera, m (%(default)s)")
    parser.add_argument("--pitch", type=float, default=60.0, help="camera pitch, degrees down (%(default)s)")
    rule = MissionSettings()
    parser.add_argument(
        "--look-pitch",
        type=float,
        default=-rule.look_pitch,
        help="camera pitch of second looks, degrees down (%(default)s)",
    )
    parser.add_argument(
        "--look-arc", type=float, default=rule.look_arc, help="minimum arc of a second look, degrees (%(default)s)"
    )
    parser.add_argument("--persons", type=int, default=3, help="people in each scene (%(default)s)")
    parser.add_argument("--people", type=Path, action="append", default=[], help="folder of random_people.py")
    parser.add_argument("--confidence", type=float, default=0.5, help="minimum probability of a box (%(default)s)")
    least = rule.candidate_probability
    parser.add_argument(
        "--candidate", type=float, default=least, help="minimum mean probability of a candidate (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=900_000, help="seed of the first scene (%(default)s)")
    parser.add_argument("--settings", type=Path, default=SETTINGS)
    parser.add_argument("--weights", type=Path, help="weights that replace those of the settings")
    parser.add_argument("--keep", type=Path, help="folder for images with false boxes")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--jobs", type=int, default=1, help="processes (%(default)s)")
    parser.add_argument("--backend", default="auto")
    options = parser.parse_args()
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    count = math.ceil(options.minutes * 60 * RATE / len(lanes(options.height, -1.0)))
    flights: list[dict[str, Any]] = []
    with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=1) as pool:
        for flight in pool.imap(partial(fly, options=options), range(options.seed, options.seed + count)):
            flights.append(flight)
            print(f"{len(flights)} of {count} scenes", flush=True)
            if options.out:
                options.out.write_text(json.dumps(flights) + "\n")
    print_tables(flights)


if __name__ == "__main__":
    main()
