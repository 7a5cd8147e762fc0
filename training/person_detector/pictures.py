"""Images with boxes from make_data.py, and crops of them to train on: mirrored, scaled, with people pasted in."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SMALLEST = 9.0  # px: people lower than this count neither as people nor as ground
HIDDEN = 0.6  # people with more hidden than this likewise


@dataclass
class Picture:
    """An image and the people in it.

    Attributes:
        name: file name.
        image: (height, width, 3) uint8 RGB.
        boxes: (n, 4) xmin, ymin, xmax, ymax, px.
        certain: (n,) False for people too small or too hidden to count.
        camera: height (m), pitch (deg, negative is down), focal (px).
    """

    name: str
    image: Array
    boxes: Array
    certain: Array
    camera: dict[str, float]
    weights: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Sprite:
    """A person cut out of a picture: its pixels, mask and viewpoint.

    Attributes:
        rgb: (h, w, 3) uint8.
        mask: (h, w) uint8, 255 is the person.
        depression: angle of the line of sight below the horizon, rad.
        distance: distance from the camera, m.
    """

    rgb: Array
    mask: Array
    depression: float
    distance: float


def is_certain(box: Array, visible: float) -> bool:
    """Return whether a person counts: tall enough and sufficiently visible."""
    return bool(box[3] - box[1] >= SMALLEST and visible >= 1.0 - HIDDEN)


def sight(camera: dict[str, float], row: float, rows: int = 360) -> tuple[float, float]:
    """Return depression (rad) and distance (m) of the ground seen in the middle of a row; inf above the horizon."""
    depression = -math.radians(camera["pitch"]) + math.atan2(row - rows / 2, camera["focal"])
    if depression < 0.03:
        return depression, math.inf
    return depression, camera["height"] / math.sin(depression)


def read_labels(folder: Path) -> list[dict[str, Any]]:
    """Return the labels of the folder's images, in the order of their creation."""
    path = Path(folder) / "labels.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def read_picture(folder: Path, label: dict[str, Any]) -> Picture:
    """Return an image of a folder by its entry in labels.jsonl."""
    image = cv2.imread(str(Path(folder) / label["file"]))
    if image is None:
        raise OSError(f"{Path(folder) / label['file']}: no image")
    boxes = np.array([person["box"] for person in label["people"]], np.float32).reshape(-1, 4)
    certain = np.array([is_certain(box, p["visible"]) for box, p in zip(boxes, label["people"], strict=True)], bool)
    return Picture(label["file"], cv2.cvtColor(image, cv2.COLOR_BGR2RGB), boxes, certain, label["camera"])


def sprites_of(folder: Path, label: dict[str, Any], picture: Picture) -> list[Sprite]:
    """Cut out the fully visible people."""
    mask = cv2.imread(str(Path(folder) / label["mask"]), cv2.IMREAD_GRAYSCALE) if label.get("mask") else None
    if mask is None:
        return []
    rows, columns = mask.shape
    cut = []
    for number, (box, person) in enumerate(zip(picture.boxes, label["people"], strict=True), 1):
        x0, y0, x1, y1 = (int(v) for v in box)
        if person["visible"] < 0.97 or x0 < 1 or y0 < 1 or x1 >= columns or y1 >= rows or y1 - y0 < 14:
            continue
        depression, distance = sight(picture.camera, y1)
        part = slice(y0, y1), slice(x0, x1)
        cut.append(
            Sprite(
                picture.image[part].copy(),
                np.where(mask[part] == number, 255, 0).astype(np.uint8),
                depression,
                distance,
            )
        )
    return cut


class Cropper:
    """Cuts random crops for training.

    Args:
        size: side of a crop, px.
        seed: seed of all random choices.
        negatives: share of the crops taken anywhere rather than around people, 0..1.
        paste: probability that people of other images are pasted into a crop, 0..1.
    """

    def __init__(self, size: int = 192, seed: int = 0, negatives: float = 0.25, paste: float = 0.5):
        self.size, self.negatives, self.paste = size, negatives, paste
        self.random = np.random.default_rng(seed)
        self.pictures: list[Picture] = []
        self.with_people: list[int] = []
        self.chances: Array = np.zeros(0)
        self.sprites: list[Sprite] = []
        self.hard: list[tuple[int, float, float]] = []
        self.depressions: Array = np.zeros(0)
        self.noise = self.random.normal(0.0, 1.0, (2 * size, 2 * size, 3)).astype(np.float32)

    def add(self, picture: Picture, sprites: list[Sprite]) -> None:
        """Add an image; call ``ready`` after the last one."""
        heights = picture.boxes[:, 3] - picture.boxes[:, 1]
        picture.weights = np.where(picture.certain, np.where((heights < 22) | (heights > 36), 1.6, 1.0), 0.0)
        self.pictures.append(picture)
        self.sprites += sprites

    def ready(self) -> None:
        """Prepare the random selection after adding images."""
        total = np.array([picture.weights.sum() for picture in self.pictures])
        self.with_people = [int(i) for i in np.flatnonzero(total)]
        self.chances = np.cumsum(total[self.with_people]) / max(total.sum(), 1e-9)
        self.sprites.sort(key=lambda sprite: sprite.depression)
        self.depressions = np.array([sprite.depression for sprite in self.sprites])

    def _place(self) -> tuple[Picture, float, float]:
        """Return an image and the centre of a crop in it."""
        random = self.random
        lot = random.random()
        if self.hard and lot < 0.6 * self.negatives:
            index, x, y = self.hard[random.integers(len(self.hard))]
            jitter = 0.35 * self.size
            return self.pictures[index], x + random.uniform(-jitter, jitter), y + random.uniform(-jitter, jitter)
        if lot < self.negatives or not self.with_people:
            picture = self.pictures[random.integers(len(self.pictures))]
            rows, columns = picture.image.shape[:2]
            return picture, random.uniform(0, columns), random.uniform(0, rows)
        index = self.with_people[min(int(np.searchsorted(self.chances, random.random())), len(self.with_people) - 1)]
        picture = self.pictures[index]
        box = picture.boxes[random.choice(len(picture.boxes), p=picture.weights / picture.weights.sum())]
        jitter = 0.4 * self.size
        x, y = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
        return picture, x + random.uniform(-jitter, jitter), y + random.uniform(-jitter, jitter)

    def crop(self) -> tuple[Array, Array, Array]:
        """Return a crop (size, size, 3) uint8, its boxes (n, 4) px, and which of them are certain."""
        random, size = self.random, self.size
        picture, x, y = self._place()
        scale = float(np.exp(random.uniform(-0.3, 0.35))) if random.random() < 0.4 else 1.0
        rows, columns = picture.image.shape[:2]
        side = min(round(size / scale), rows)
        scale = size / side
        x0 = int(np.clip(x - side / 2, 0, columns - side))
        # occasionally beyond the upper or lower edge of the image, like the bars of the letterbox
        over = 14 if random.random() < 0.3 else 0
        y0 = int(np.clip(y - side / 2, -over, rows - side + over))
        image = picture.image[max(y0, 0) : y0 + side, x0 : x0 + side]
        above, below = max(-y0, 0), max(y0 + side - rows, 0)
        if above or below:
            grey = int(random.choice([0, 114, 127]))
            image = cv2.copyMakeBorder(image, above, below, 0, 0, cv2.BORDER_CONSTANT, value=(grey, grey, grey))
        if scale != 1.0:
            image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        else:
            image = np.ascontiguousarray(image) if above or below else image.copy()
        boxes = (picture.boxes - np.array([x0, y0, x0, y0], np.float32)) * scale
        boxes, certain = _clip(boxes, picture.certain, size)
        if self.sprites and random.random() < self.paste:
            boxes, certain = self._paste(image, boxes, certain, picture.camera, (y0, scale))
        if random.random() < 0.5:
            image = np.ascontiguousarray(image[:, ::-1])
            boxes = boxes[:, [2, 1, 0, 3]] * np.array([-1, 1, -1, 1], np.float32) + np.array(
                [size, 0, size, 0], np.float32
            )
        return image, boxes, certain

    def _paste(
        self, image: Array, boxes: Array, certain: Array, camera: dict[str, float], window: tuple[int, float]
    ) -> tuple[Array, Array]:
        """Paste people of other images at places with the same viewing angle and distance."""
        random, size = self.random, self.size
        y0, scale = window
        new = []
        for _ in range(random.integers(1, 4)):
            x, y = random.uniform(4, size - 4), random.uniform(0.15 * size, size - 1)
            depression, distance = sight(camera, y0 + y / scale)
            if not math.isfinite(distance):
                continue
            near = np.searchsorted(self.depressions, [depression - 0.12, depression + 0.12])
            if near[1] - near[0] < 3:
                continue
            sprite = self.sprites[random.integers(near[0], near[1])]
            factor = scale * sprite.distance / distance * random.uniform(0.85, 1.15)
            height, width = round(sprite.rgb.shape[0] * factor), round(sprite.rgb.shape[1] * factor)
            if not (9 <= height <= 0.7 * size and width >= 3 and factor < 1.8):
                continue
            left, top = int(x - width / 2), int(y - height)
            if left < 0 or top < 0 or left + width > size or top + height > size:
                continue
            box = np.array([left, top, left + width, top + height], np.float32)
            if any(_overlap(box, other) > 0.15 for other in [*boxes, *new]):
                continue
            _lay(image[top : top + height, left : left + width], self._recoloured(sprite), random)
            new.append(box)
        if not new:
            return boxes, certain
        return np.concatenate([boxes, np.array(new, np.float32)]), np.concatenate([certain, np.ones(len(new), bool)])

    def _recoloured(self, sprite: Sprite) -> Sprite:
        """Return a person with other clothes and light: bands of other colours, brightness, hue."""
        random = self.random
        rgb = sprite.rgb.astype(np.float32)
        rows = len(rgb)
        if random.random() < 0.6:
            waist = round(rows * random.uniform(0.4, 0.6))
            for part in (slice(round(rows * random.uniform(0.1, 0.22)), waist), slice(waist, rows)):
                if random.random() < 0.7:
                    band = rgb[part]
                    grey = band.mean(2, keepdims=True)
                    grey = grey / max(float(grey.mean()), 1.0)
                    cloth = random.uniform(10, 235) * np.clip(1 + random.normal(0, 0.35, 3), 0.15, 2)
                    rgb[part] = grey * cloth * (1 - 0.15) + 0.15 * band
        rgb *= random.uniform(0.75, 1.3)
        return Sprite(np.clip(rgb, 0, 255).astype(np.uint8), sprite.mask, sprite.depression, sprite.distance)

    def _lit(self, image: Array) -> Array:
        """Return a crop in another light: contrast, brightness, colour, saturation, noise, slight blur."""
        random = self.random
        if random.random() < 0.5:
            grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
            part = random.uniform(0.6, 1.35)
            image = cv2.addWeighted(image, part, grey, 1 - part, 0)
        gain = random.uniform(0.65, 1.4) * random.uniform(0.88, 1.12, 3)
        levels = np.arange(256, dtype=np.float32)[:, None] * gain + random.uniform(-15, 15)
        image = cv2.LUT(image, np.clip(levels, 0, 255).astype(np.uint8)[None])
        if random.random() < 0.15:
            image = cv2.GaussianBlur(image, (3, 3), random.uniform(0.3, 0.8))
        if random.random() < 0.3:
            x, y = random.integers(0, self.size, 2)
            part = self.noise[y : y + self.size, x : x + self.size]
            image = np.clip(image + part * random.uniform(1, 8), 0, 255).astype(np.uint8)
        return image

    def batch(self, count: int) -> tuple[Array, Array]:
        """Return crops (count, size, size, 3) uint8 and people (n, 6): crop, xmin, ymin, xmax, ymax, certain."""
        images = np.empty((count, self.size, self.size, 3), np.uint8)
        people = []
        for index in range(count):
            image, boxes, certain = self.crop()
            images[index] = self._lit(image)
            people.append(np.column_stack([np.full(len(boxes), index, np.float32), boxes, certain.astype(np.float32)]))
        return images, np.concatenate(people).astype(np.float32)


def _clip(boxes: Array, certain: Array, size: int) -> tuple[Array, Array]:
    """Clip boxes at the crop's edges; those with less than half their area left are no longer certain."""
    inside = np.clip(boxes, 0, size)
    left = (inside[:, 2] - inside[:, 0]) * (inside[:, 3] - inside[:, 1])
    whole = np.maximum((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]), 1e-6)
    kept = (inside[:, 2] - inside[:, 0] > 1) & (inside[:, 3] - inside[:, 1] > 1)
    sure = certain & (left > 0.5 * whole) & (inside[:, 3] - inside[:, 1] >= 0.8 * SMALLEST)
    return inside[kept], sure[kept]


def _overlap(one: Array, other: Array) -> float:
    """Return the share of the smaller box that lies in the other."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (one, other)]
    return float(width * height / max(min(areas), 1e-6))


def _lay(part: Array, sprite: Sprite, random: np.random.Generator) -> None:
    """Draw a person over a part of an image, in place, scaled to its size."""
    height, width = part.shape[:2]
    smaller = height < sprite.rgb.shape[0]
    way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    rgb = cv2.resize(sprite.rgb, (width, height), interpolation=way).astype(np.float32)
    mask = cv2.resize(sprite.mask, (width, height), interpolation=way).astype(np.float32) / 255
    if random.random() < 0.3:
        rgb = cv2.GaussianBlur(rgb, (3, 3), 0.5)
        mask = cv2.GaussianBlur(mask, (3, 3), 0.5)
    mask = mask[..., None]
    part[:] = (rgb * mask + part * (1 - mask)).astype(np.uint8)


def load(
    cropper: Cropper, folder: Path, start: int = 0, accept: Callable[[dict[str, Any]], bool] = lambda label: True
) -> int:
    """Add a folder's images from entry ``start`` on; return the number of entries read so far."""
    labels = read_labels(folder)
    for label in labels[start:]:
        if accept(label):
            picture = read_picture(folder, label)
            cropper.add(picture, sprites_of(folder, label, picture))
    if len(labels) > start:
        cropper.ready()
    return len(labels)
