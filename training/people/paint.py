"""Clothes: the covered parts of the body, the distance from the skin, and the colours as a texture.

A texture shows the body at rest from the front and from the back, side by side; below lie the skirt from both sides
and sixteen cells of plain colours.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from makehuman import JOINT, Base
from wardrobe import HAIRS, SKINS, Cloth, Figure, Rgb

WIDTH, HEIGHT = 256, 320
_BODY_ROWS, _SKIRT_ROWS, _CELL = 256, 48, 16


class Region(IntEnum):
    """The visible material at a point of the body."""

    SKIN, HAIR, TOP, BOTTOM, SHOES, HAT, VEST, BAND, OPEN, EYE, LIPS, BEARD, SOLE = range(13)


CELLS = {"hair": 0, "hat": 1, "backpack": 2}


@dataclass(frozen=True)
class Marks:
    """Positions of points on the body, independent of its build.

    Attributes:
        place: position on the base mesh, (N, 3), m.
        arm: (N,), 0 shoulder, 1 elbow, 2 wrist; 0 off the arms.
        leg: (N,), 0 hip, 1 knee, 2 ankle; 0 off the legs.
        head: (N,), share of the head and neck.
    """

    place: np.ndarray
    arm: np.ndarray
    leg: np.ndarray
    head: np.ndarray

    def mix(self, triangles: np.ndarray, shares: np.ndarray) -> Marks:
        """Return the marks at points of triangles (T, 3), ``shares`` (S, 3) of their corners, (T S)."""
        parts = [
            np.einsum("sc,tc...->ts...", shares, field[triangles]).reshape(-1, *field.shape[1:])
            for field in self._fields()
        ]
        return Marks(*parts)

    def take(self, index: np.ndarray) -> Marks:
        """Return the marks of some of the points."""
        return Marks(*(field[index] for field in self._fields()))

    def _fields(self) -> tuple[np.ndarray, ...]:
        return self.place, self.arm, self.leg, self.head


def marks(base: Base) -> Marks:
    """Return the marks of the base mesh's vertices."""
    joints, weights = base.joints(base.vertices), base.weights
    total = {"arm": np.zeros(len(weights)), "leg": np.zeros(len(weights))}
    for limb, chain in (("arm", ("upperarm", "lowerarm", "hand")), ("leg", ("thigh", "calf", "foot"))):
        for side in "lr":
            for step, name in enumerate(chain):
                first = joints[JOINT[f"{name}_{side}"]]
                if step < 2:
                    bone = joints[JOINT[f"{chain[step + 1]}_{side}"]] - first
                    along = np.clip((base.vertices - first) @ bone / (bone @ bone), 0.0, 1.0)
                else:
                    along = np.full(len(weights), 0.3)
                share = weights[:, JOINT[f"{name}_{side}"]].copy()
                if name == "foot":
                    share += weights[:, JOINT[f"ball_{side}"]]
                total[limb] += share * (step + along)
    head = weights[:, JOINT["head"]] + weights[:, JOINT["neck"]]
    return Marks(base.vertices, total["arm"], total["leg"], head)


def regions(at: Marks, figure: Figure) -> np.ndarray:
    """Return the region of each point, (N,)."""
    outfit = figure.outfit
    x, y, z = at.place.T
    out = np.full(len(x), int(Region.SKIN))
    on_head = at.head > 0.5
    hairline = np.interp(x, [-0.04, 0.0, 0.04, 0.07, 0.12, 0.15], [0.64, 0.67, 0.73, 0.765, 0.795, 0.805])
    out[on_head & (z > 0.722) & (z < 0.738) & (np.abs(np.abs(y) - 0.032) < 0.010) & (x > 0.1)] = Region.EYE
    out[on_head & (np.abs(z - 0.672) < 0.007) & (np.abs(y) < 0.022) & (x > 0.1)] = Region.LIPS
    if figure.beard:
        out[on_head & (z < 0.69) & (z > 0.605) & (x > 0.04) & (out != Region.LIPS)] = Region.BEARD
    if figure.cut != "bald":
        out[on_head & (z > hairline)] = Region.HAIR
    if outfit.hat:
        rim = {"cap": 0.775, "sunhat": 0.775, "helmet": 0.765, "beanie": 0.755}[outfit.hat] + 0.12 * np.minimum(x, 0.1)
        out[on_head & (z > rim)] = Region.HAT
    trunk = at.arm < 0.25
    waist = 0.12
    lower = (at.leg > 0.0) | (trunk & (z < waist))
    length = outfit.leg if not outfit.skirt else 0.75 * min(1.0, 2.0 * outfit.skirt)  # under a skirt
    out[lower & (at.arm < 0.5) & (z < waist) & (at.leg < length)] = Region.BOTTOM
    neckline = np.interp(x, [-0.06, 0.0, 0.06, 0.1], [0.585, 0.575, 0.555, 0.54])
    hem = waist if outfit.tucked or outfit.skirt else 0.015
    top = (
        ((z < neckline) | (np.abs(y) > 0.085))
        & (at.head < 0.8)
        & (at.arm < outfit.sleeve)
        & ((z > hem) | ~trunk)
        & ((at.leg == 0.0) | (z > hem))
    )
    out[top] = Region.TOP
    if outfit.open is not None:
        out[top & trunk & (x > 0.02) & (np.abs(y) < 0.02 + 0.05 * np.clip((z - 0.1) / 0.45, 0.0, 1.0))] = Region.OPEN
    if outfit.vest is not None:
        vest = top & (at.arm < 0.12) & (z > 0.03)
        out[vest] = Region.VEST
        bands = (np.abs(z - 0.15) < 0.025) | (np.abs(z - 0.27) < 0.025) | (np.abs(np.abs(y) - 0.09) < 0.02) & (z > 0.27)
        out[vest & bands] = Region.BAND
    out[(at.leg > (1.62 if outfit.boots else 1.93))] = Region.SHOES
    out[(at.leg > 1.9) & (z < -0.803)] = Region.SOLE
    return out


def thickness(at: Marks, figure: Figure) -> np.ndarray:
    """Return the distance of the surface from the skin, (N,), m."""
    outfit = figure.outfit
    where = regions(at, figure)
    hat = {"": 0.0, "cap": 0.020, "beanie": 0.022, "sunhat": 0.025, "helmet": 0.038}[outfit.hat]
    hair = {"bald": 0.0, "cropped": 0.006, "short": 0.016, "long": 0.014, "bun": 0.010}[figure.cut]
    depth = np.zeros(len(where))
    top = outfit.thick + (0.008 if outfit.vest else 0.0)
    for region, value in (
        (Region.HAIR, hair),
        (Region.HAT, hat),
        (Region.TOP, outfit.thick),
        (Region.OPEN, outfit.thick),
        (Region.VEST, top),
        (Region.BAND, top),
        (Region.SHOES, 0.010),
        (Region.SOLE, 0.010),
        (Region.BEARD, 0.010),
    ):
        depth[where == region] = value
    trousers = where == Region.BOTTOM
    if not outfit.skirt:
        depth[trousers] = outfit.loose * (0.5 + 0.5 * np.clip(at.leg[trousers], 0.0, 1.6))
    return depth


def _cloth(cloth: Cloth, at: Marks) -> np.ndarray:
    """Return a cloth's colours at points, (N, 3)."""
    _, y, z = at.place.T
    out = np.tile(np.array(cloth.colour, dtype=float), (len(y), 1))
    second = np.array(cloth.second, dtype=float)
    level, upright = (np.mod(v / cloth.period, 1.0) < 0.45 for v in (z, y))
    if cloth.pattern == "stripes":
        out[level] = second
    elif cloth.pattern == "pinstripes":
        out[upright] = second
    elif cloth.pattern == "checks":
        share = 0.5 * (level.astype(float) + upright)
        out += share[:, None] * (second - out)
    return out


def colours(at: Marks, figure: Figure) -> np.ndarray:
    """Return the colours of points of the body, (N, 3), 0..255."""
    outfit, where = figure.outfit, regions(at, figure)
    skin, hair = np.array(SKINS[figure.skin], dtype=float), np.array(HAIRS[figure.hair], dtype=float)
    out = np.tile(skin, (len(where), 1))
    plain: dict[Region, Rgb | np.ndarray] = {
        Region.HAIR: hair,
        Region.BEARD: 0.75 * hair + 0.25 * skin,
        Region.SHOES: outfit.shoes,
        Region.SOLE: tuple(int(0.5 * c + 60) for c in outfit.shoes),
        Region.HAT: outfit.hat_colour,
        Region.BAND: (214, 216, 210),
        Region.EYE: (40, 32, 30),
        Region.LIPS: 0.7 * skin + np.array([30.0, 0.0, 0.0]),
    }
    if outfit.vest is not None:
        plain[Region.VEST] = outfit.vest
    if outfit.open is not None:
        plain[Region.OPEN] = outfit.open
    for region, colour in plain.items():
        out[where == region] = colour
    for region, cloth in ((Region.TOP, outfit.top), (Region.BOTTOM, outfit.bottom)):
        out[where == region] = _cloth(cloth, at.take(where == region))
    return out


@dataclass(frozen=True)
class Layout:
    """Positions of a body's points in its texture.

    Attributes:
        low, high: bounds of the body, (3,), m.
        skirt_low, skirt_high: bounds of the skirt, likewise.
    """

    low: np.ndarray
    high: np.ndarray
    skirt_low: np.ndarray
    skirt_high: np.ndarray

    def pixels(self, points: np.ndarray, front: np.ndarray, skirt: bool) -> np.ndarray:
        """Return columns and rows (N, 2) of points (N, 3) seen from the front or the back (N, bool)."""
        low, high = (self.skirt_low, self.skirt_high) if skirt else (self.low, self.high)
        first, rows = (_BODY_ROWS, _SKIRT_ROWS) if skirt else (0, _BODY_ROWS)
        half = max(abs(low[1]), abs(high[1]))
        across = 0.5 - 0.5 * points[:, 1] / half  # mirrored: seen from the front, the left hand is on the right
        column = np.where(front, 0, WIDTH // 2) + 3.0 + across * (WIDTH // 2 - 6)
        row = first + 3.0 + (high[2] - points[:, 2]) / (high[2] - low[2]) * (rows - 6)
        return np.column_stack([column, row])


def cell_pixels(name: str, count: int) -> np.ndarray:
    """Return the centre of a plain cell, ``count`` times, (count, 2)."""
    middle = [CELLS[name] * _CELL + 0.5 * _CELL, _BODY_ROWS + _SKIRT_ROWS + 0.5 * _CELL]
    return np.tile(np.array(middle), (count, 1))


def uv(pixels: np.ndarray) -> np.ndarray:
    """Return texture coordinates (N, 2), from the lower left corner, of columns and rows."""
    return np.column_stack([pixels[:, 0] / WIDTH, 1.0 - pixels[:, 1] / HEIGHT])


def _barycentric(steps: int) -> np.ndarray:
    grid = [(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]
    return np.array(grid, dtype=float) / steps


@dataclass(frozen=True)
class Surface:
    """A fine surface to be painted.

    Attributes:
        points: (V, 3) in the person's build.
        triangles: (T, 3).
        at: marks of the points.
        skirt: whether it is the skirt.
    """

    points: np.ndarray
    triangles: np.ndarray
    at: Marks
    skirt: bool


def texture(figure: Figure, layout: Layout, surfaces: list[Surface], rng: np.random.Generator) -> np.ndarray:
    """Paint a person's texture, (HEIGHT, WIDTH, 3) uint8."""
    picture = np.zeros((HEIGHT, WIDTH, 3))
    known = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for surface in surfaces:
        _splat(picture, known, figure, layout, surface)
    for top, bottom in ((0, _BODY_ROWS), (_BODY_ROWS, _BODY_ROWS + _SKIRT_ROWS)):
        for left in (0, WIDTH // 2):
            part = np.s_[top:bottom, left : left + WIDTH // 2]
            _fill(picture[part], known[part])
    picture *= _folds(rng)[..., None]
    cells = {"hair": HAIRS[figure.hair], "hat": figure.outfit.hat_colour, "backpack": figure.outfit.backpack or BLANK}
    for name, index in CELLS.items():
        picture[_BODY_ROWS + _SKIRT_ROWS :, index * _CELL : (index + 1) * _CELL] = cells[name]
    return (np.clip(picture, 0.0, 255.0) / 4.0).round().clip(0, 63).astype(np.uint8) * 4


BLANK: Rgb = (128, 128, 128)


def _splat(picture: np.ndarray, known: np.ndarray, figure: Figure, layout: Layout, surface: Surface) -> None:
    """Paint a surface as dense points, those in front last."""
    corners = surface.points[surface.triangles]
    ahead = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 0]
    shares = _barycentric(10 if surface.skirt else 6)
    for front in (True, False):
        triangles = surface.triangles[ahead > 0.0 if front else ahead < 0.0]
        points = (shares @ surface.points[triangles]).reshape(-1, 3)
        at = surface.at.mix(triangles, shares)
        paint = _cloth(figure.outfit.bottom, at) if surface.skirt else colours(at, figure)
        pixels = layout.pixels(points, np.full(len(points), front), surface.skirt).astype(int)
        order = np.argsort(points[:, 0] if front else -points[:, 0], kind="stable")
        picture[pixels[order, 1], pixels[order, 0]] = paint[order]
        known[pixels[order, 1], pixels[order, 0]] = True


def _fill(picture: np.ndarray, known: np.ndarray) -> None:
    """Spread the known pixels over the others."""
    while known.any() and not known.all():
        sums, counts = np.zeros_like(picture), np.zeros(known.shape)
        for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            rolled = np.roll(known, (down, right), axis=(0, 1))
            rolled[{1: 0, -1: -1}[down] if down else slice(None), {1: 0, -1: -1}[right] if right else slice(None)] = (
                False
            )
            sums += np.roll(picture, (down, right), axis=(0, 1)) * rolled[..., None]
            counts += rolled
        new = ~known & (counts > 0)
        picture[new] = sums[new] / counts[new][:, None]
        known |= new


def _folds(rng: np.random.Generator) -> np.ndarray:
    """Return smooth shades around 1, (HEIGHT, WIDTH)."""
    coarse = rng.normal(0.0, 0.07, (HEIGHT // 8 + 2, WIDTH // 8 + 2))
    rows, columns = np.arange(HEIGHT) / 8.0, np.arange(WIDTH) / 8.0
    i, j = rows.astype(int), columns.astype(int)
    s, t = (rows - i)[:, None], (columns - j)[None, :]
    upper = coarse[i][:, j] * (1 - t) + coarse[i][:, j + 1] * t
    lower = coarse[i + 1][:, j] * (1 - t) + coarse[i + 1][:, j + 1] * t
    return 1.0 + upper * (1 - s) + lower * s


def png(picture: np.ndarray) -> bytes:
    """Return an image (H, W, 3) uint8 as PNG."""
    height, width, _ = picture.shape
    rows = b"".join(b"\0" + row.tobytes() for row in picture)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")
