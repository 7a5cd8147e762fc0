#!/usr/bin/env python3
"""Makes images of the simulator's scenes with people, and their exact boxes.

    make_data.py DATA/train --split train --scenes 100 --people FOLDER_OF_figures.py
    make_data.py DATA/test --split test --scenes 16 --seed 1000

Every scene is drawn from the heights and angles of a search. Each image NNNNN_MM.png has an entry in labels.jsonl,
written after the picture: the camera, and for each person the box of the visible part (xmin, ymin, xmax, ymax, px), the
name and the visible share; the mask NNNNN_MM.mask.png contains 1 + the person's number at its pixels. Runs in
`./xtdrone shell`.
"""

from __future__ import annotations

import argparse
import fcntl
import itertools
import json
import math
import multiprocessing
import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.camera_pose import camera_link_pose, mount_orientation, optical_pose
from xtdrone_common.poses import Pose, compose, rotate
from xtdrone_common.rotation import from_euler
from xtdrone_sim.cameras.rendering import Renderer
from xtdrone_sim.vehicles.vehicle_model import VehicleModel, load_vehicle
from xtdrone_worlds.shapes.visual import Mesh, Visual
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.scenery import FreeGround, outdoor
from xtdrone_worlds.worlds.sdf import SdfWorld
from xtdrone_worlds.worlds.urdf import Description

VEHICLE = "typhoon_h480"
HEIGHTS = ((8, 15), (15, 25), (5, 8), (0.4, 5))  # m
SHARES = (0.70, 0.12, 0.14, 0.04)  # shares of the views
OTHERS = 5  # other vehicles of the swarm
NEARS = (0.05, 0.1, 0.3, 0.5)  # m; the ground's layers blend more or less
FAR = 500.0
REGION = (-10.0, -10.0, 90.0, 50.0)


@dataclass(frozen=True)
class View:
    """Viewpoint of an image.

    Attributes:
        position: position of the vehicle, m.
        yaw, pitch, roll: attitude of the camera, rad; pitch is negative downwards.
        tilt: roll and pitch of the vehicle, rad.
        near: near limit of the camera, m.
    """

    position: tuple[float, float, float]
    yaw: float
    pitch: float
    roll: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    near: float = NEARS[0]


class Scene:
    """A scene with people at variable positions."""

    def __init__(self, world: SdfWorld, backend: str = "auto"):
        self.renderer = Renderer(backend)
        self.light = world.light
        self.statics: list[tuple[int, Pose]] = []
        for model in world.models:
            for link in model.links:
                if link.visuals:
                    self.statics.append((self.renderer.add(link.visuals), compose(model.pose, link.pose)))
        self.model = load_vehicle(VEHICLE)
        self.camera = self.model.cameras[0]
        self.offset = camera_offset(self.model)
        whole = all_visuals(self.model.urdf)
        self.others = [self.renderer.add(whole) for _ in range(OTHERS)]
        self.show(True)
        self.put_others([])

    def show(self, shown: bool) -> None:
        """Show or hide the objects of the scene."""
        for body, pose in self.statics:
            if shown:
                self.renderer.place(body, pose)
            else:
                self.renderer.hide(body)

    def put_others(self, poses: list[Pose]) -> None:
        """Place other vehicles of the swarm, and hide the unused ones."""
        for body, pose in itertools.zip_longest(self.others, poses):
            if pose is None:
                self.renderer.hide(body)
            else:
                self.renderer.place(body, pose)

    def pose(self, view: View) -> Pose:
        """Return the camera's optical frame in a view."""
        attitude = from_euler(view.tilt[0], view.tilt[1], view.yaw)
        mount = mount_orientation(view.roll, view.pitch, 0.0)
        found = optical_pose(camera_link_pose(view.position, attitude, mount, self.offset))
        return Pose(found.position, found.orientation)

    def draw(self, view: View, labels: bool) -> Any:
        """Return the image of a view; the vehicle itself is not visible because its legs are raised in flight."""
        return self.renderer.draw(self.camera.pinhole, self.pose(view), view.near, FAR, self.light, labels)


def all_visuals(urdf: Description) -> list[Visual]:
    """Return the visuals of a vehicle at joint positions 0, in its body frame."""
    found = []
    for part in urdf.moving:
        pose, link = Pose(), part.name
        while (joint := urdf.holder(link)) is not None:
            pose, link = compose(joint.pose, pose), joint.parent
        found += [replace(visual, pose=compose(pose, visual.pose)) for visual in part.visuals]
    return found


def camera_offset(model: VehicleModel) -> tuple[float, float, float]:
    """Return the position of the camera's link on the vehicle, gimbal at rest, m."""
    pose, link = Pose(), model.cameras[0].link
    while (joint := model.urdf.holder(link)) is not None:
        pose, link = compose(joint.pose, pose), joint.parent
    return pose.position


def random_view(random: np.random.Generator) -> View:
    """Return a random view of a search: mostly 8 to 15 m high, 35 to 60 degrees down."""
    low, high = HEIGHTS[random.choice(len(HEIGHTS), p=SHARES)]
    height = random.uniform(low, high)
    pitch = random.uniform(35, 60) if random.random() < 0.7 else random.uniform(25, 75)
    x0, y0, x1, y1 = REGION
    return View(
        (float(random.uniform(x0, x1)), float(random.uniform(y0, y1)), float(height)),
        float(random.uniform(-math.pi, math.pi)),
        -math.radians(pitch),
        math.radians(random.normal(0, 1.0)),
        (math.radians(random.normal(0, 5)), math.radians(random.normal(2, 5))),
        float(random.choice(NEARS)),
    )


def random_others(view: View, random: np.random.Generator) -> list[Pose]:
    """Return random poses of other vehicles: in half of the views, at a similar height, some of them in sight."""
    count = int(random.integers(1, OTHERS + 1)) if random.random() < 0.5 else 0
    x, y, z = view.position
    found = []
    for _ in range(count):
        away = random.uniform(2.0, 30.0)
        bearing = view.yaw + random.uniform(-1.2, 1.2)
        height = max(0.2, z + random.uniform(-1.0, 0.15) * min(away, 8.0))
        place = (x + away * math.cos(bearing), y + away * math.sin(bearing), height)
        tilt = random.normal(0, 0.1, 2)
        found.append(Pose(place, from_euler(tilt[0], tilt[1], random.uniform(-math.pi, math.pi))))
    return found


def random_light(light: Any, random: np.random.Generator) -> Any:
    """Return the light slightly brighter or darker, warmer or colder."""
    gain = random.uniform(0.85, 1.15)

    def changed(colour: Any) -> tuple[float, ...]:
        return tuple(float(v) for v in np.clip(np.array(colour) * gain * random.uniform(0.95, 1.05, 3), 0.05, 1.0))

    return replace(light, diffuse=changed(light.diffuse), ambient=changed(light.ambient))


class Crowd:
    """People in random postures for a scene."""

    def __init__(
        self, scene: Scene, bodies: list[tuple[str, people_meshes.Body, Path]], count: int, folder: Path, random: Any
    ):
        self.scene, self.random = scene, random
        self.members: list[tuple[str, int, float]] = []
        for number in range(count):
            name, body, texture = bodies[random.integers(len(bodies))]
            posture = 0 if random.random() < 0.35 else int(random.integers(1, len(body.poses)))
            file = folder / f"{number}.obj"
            file.write_text(people_meshes.wavefront(body, posture))
            size = float(random.uniform(0.93, 1.07))
            tint = tuple(float(v) for v in np.clip(random.uniform(0.75, 1.0) * random.uniform(0.9, 1.0, 3), 0, 1))
            mesh = Mesh(file, (size * float(random.uniform(0.95, 1.05)), size, size))
            index = scene.renderer.add([Visual(mesh, colour=(*tint, 1.0), texture=texture)])
            scene.renderer.hide(index)
            self.members.append((name, index, body.height * size))

    def put(self, view: View, ground: FreeGround, count: int) -> dict[int, Pose]:
        """Return poses for ``count`` people in a view, by body: all sizes, mostly on free ground."""
        random, pinhole = self.random, self.scene.camera.pinhole
        pose = self.scene.pose(view)
        chosen = random.permutation(len(self.members))[:count]
        places: dict[int, Pose] = {}
        for member in chosen:
            _, index, tall = self.members[member]
            for _ in range(30):
                pixel = np.array([[random.uniform(2, pinhole.width - 2), random.uniform(2, pinhole.height + 10)]])
                ray = np.array(rotate(pose.orientation, tuple(pinhole.rays(pixel)[0])))
                if ray[2] > -0.02:
                    continue
                x, y, _ = np.array(pose.position) - ray * pose.position[2] / ray[2]
                distance = math.dist((x, y, 0.0), pose.position)
                slope = math.hypot(ray[0], ray[1]) / float(np.linalg.norm(ray))
                seen = pinhole.fx * tall * max(slope, 0.35) / distance
                if seen < 7 or (seen < 12 and random.random() < 0.6):
                    continue
                if random.random() > 0.12 and not ground.is_free(x, y, 0.3):
                    continue
                if any(math.dist((x, y), other.position[:2]) < 0.5 for other in places.values()):
                    continue
                places[index] = Pose((float(x), float(y), 0.0), from_euler(0.0, 0.0, random.uniform(-3.1, 3.1)))
                break
        return places

    def show(self, places: dict[int, Pose]) -> None:
        """Place people, and hide all others."""
        for _, index, _ in self.members:
            if index in places:
                self.scene.renderer.place(index, places[index])
            else:
                self.scene.renderer.hide(index)


def people_of(split: str, folders: list[Path]) -> list[tuple[str, people_meshes.Body, Path]]:
    """Return name, body and texture of a split's people, from the simulator and from folders."""
    found = []
    for folder in [people_meshes.models_folder(), *folders]:
        for file in sorted(folder.glob("*.npz")):
            body = people_meshes.read_file(file)
            if body.split == split:
                found.append((file.stem, body, file.with_suffix(".png")))
    return found


def label_of(person: str, seen: NDArray[np.bool_], whole: int) -> dict[str, Any] | None:
    """Return a person's entry, from its visible pixels and its number of pixels without occlusion."""
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    if not len(rows):
        return None
    box = [int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1]
    visible = min(1.0, float(seen.sum()) / max(whole, 1))
    return {"person": person, "box": box, "visible": round(visible, 3), "pixels": int(seen.sum())}


def make_scene(number: int, options: argparse.Namespace) -> int:
    """Draw a scene's images; return their number."""
    random = np.random.default_rng((options.seed, number))
    world = outdoor(
        options.seed * 100_000 + number,
        region=REGION,
        persons=0,
        split=options.split,
        objects=float(random.uniform(0.6, 1.8)),
        light="any",
    )
    scene = Scene(world, options.backend)
    ground = FreeGround(world)
    names = people_of(options.split, options.people)
    with tempfile.TemporaryDirectory() as temporary:
        crowd = Crowd(scene, names, options.crowd, Path(temporary), random)
        light = scene.light
        views, drawn = [], []
        for _ in range(options.pictures):
            view = random_view(random)
            count = 0 if random.random() < options.empty else int(random.integers(3, options.crowd))
            places = crowd.put(view, ground, count)
            crowd.show(places)
            scene.put_others(random_others(view, random))
            scene.light = random_light(light, random)
            drawn.append(scene.draw(view, labels=True))
            views.append((view, places))
        scene.show(False)
        scene.put_others([])
        whole = []
        for view, places in views:
            crowd.show(places)
            whole.append(scene.draw(view, labels=True).labels if places else None)
        scene.renderer.close()
    known = {index: name for name, index, _ in crowd.members}
    for index, (picture, alone, (view, places)) in enumerate(zip(drawn, whole, views, strict=True)):
        write(
            options.out, f"{options.seed:04d}_{number:05d}_{index:02d}", (picture, alone), (view, places), known, scene
        )
    return len(drawn)


def write(
    folder: Path,
    name: str,
    drawn: tuple[Any, Any],
    view: tuple[View, dict[int, Pose]],
    known: dict[int, str],
    scene: Scene,
) -> None:
    """Write an image, its mask and its entry in labels.jsonl."""
    picture, alone = drawn
    mask = np.zeros(picture.labels.shape, np.uint8)
    found = []
    for body in view[1]:
        seen = picture.labels == body
        entry = label_of(known[body], seen, int((alone == body).sum()))
        if entry is not None:
            found.append(entry)
            mask[seen] = len(found)
    quick = [cv2.IMWRITE_PNG_COMPRESSION, 2]
    cv2.imwrite(str(folder / f"{name}.png"), cv2.cvtColor(picture.rgb, cv2.COLOR_RGB2BGR), quick)
    if found:
        cv2.imwrite(str(folder / f"{name}.mask.png"), mask)
    label = {
        "file": f"{name}.png",
        "mask": f"{name}.mask.png" if found else None,
        "camera": {
            "height": round(view[0].position[2] + scene.offset[2], 3),
            "pitch": round(math.degrees(view[0].pitch), 2),
            "focal": scene.camera.pinhole.fx,
        },
        "people": found,
    }
    with open(folder / "labels.jsonl", "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(json.dumps(label) + "\n")


def main() -> None:
    """Make images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="output folder; images are added to those of other seeds")
    parser.add_argument("--split", choices=("train", "test"), required=True, help="split of scenery and people")
    parser.add_argument("--scenes", type=int, default=100, help="number of scenes (%(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (%(default)s)")
    parser.add_argument("--pictures", type=int, default=24, help="number of images per scene (%(default)s)")
    parser.add_argument("--crowd", type=int, default=16, help="people in a scene; an image has 3 or more (%(default)s)")
    parser.add_argument("--empty", type=float, default=0.15, help="share of images without people (%(default)s)")
    parser.add_argument("--people", type=Path, action="append", default=[], help="folder of random_people.py")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--backend", default="auto")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    numbers = range(options.first, options.first + options.scenes)
    total = 0
    # one process per scene, which releases the renderer's memory
    with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=1) as pool:
        for done, count in enumerate(pool.imap_unordered(partial(make_scene, options=options), numbers), 1):
            total += count
            print(f"{done} of {len(numbers)} scenes, {total} images", flush=True)


if __name__ == "__main__":
    main()
