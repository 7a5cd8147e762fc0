"""Appearance of the people: builds, skins, hair and clothes, and the split for training and tests of detectors."""

from __future__ import annotations

from dataclasses import dataclass, field

from gait import Style
from makehuman import Build

Rgb = tuple[int, int, int]

SKINS: dict[str, Rgb] = {
    "pale": (232, 196, 174),
    "light": (218, 176, 148),
    "olive": (188, 144, 110),
    "brown": (138, 96, 68),
    "dark": (86, 60, 46),
}
HAIRS: dict[str, Rgb] = {
    "black": (30, 26, 24),
    "brown": (74, 50, 34),
    "fair": (176, 138, 84),
    "red": (142, 70, 34),
    "grey": (150, 148, 144),
    "white": (212, 210, 204),
}


@dataclass(frozen=True)
class Cloth:
    """Appearance of a cloth.

    Attributes:
        colour: background colour.
        pattern: "plain", "stripes" (level), "pinstripes" (upright) or "checks".
        second: colour of the pattern.
        period: period of the pattern, m.
    """

    colour: Rgb
    pattern: str = "plain"
    second: Rgb = (240, 240, 240)
    period: float = 0.08


@dataclass(frozen=True)
class Outfit:
    """Clothes of a person.

    Attributes:
        top, bottom: cloths.
        sleeve: how far the sleeves extend along the arm: 0 shoulder, 1 elbow, 2 wrist.
        leg: how far the trousers extend along the leg: 0 hip, 1 knee, 2 ankle.
        skirt: length of a skirt in place of trousers, as a share of the way to the ankles; 0 for none.
        thick: distance of the top from the skin, m.
        loose: distance of the trousers from the skin, m.
        tucked: whether the top ends at the waist instead of over the hips.
        open: colour under a jacket that is open in front; None: closed.
        vest: colour of a high-visibility vest with bands; None for none.
        shoes: colour of the shoes.
        boots: whether they reach up the leg.
        hat: "", "cap", "sunhat", "helmet" or "beanie".
        hat_colour: colour of the hat.
        backpack: colour of the backpack; None for none.
    """

    top: Cloth
    bottom: Cloth
    sleeve: float = 2.0
    leg: float = 2.0
    skirt: float = 0.0
    thick: float = 0.008
    loose: float = 0.010
    tucked: bool = False
    open: Rgb | None = None
    vest: Rgb | None = None
    shoes: Rgb = (40, 38, 38)
    boots: bool = False
    hat: str = ""
    hat_colour: Rgb = (40, 60, 120)
    backpack: Rgb | None = None


@dataclass(frozen=True)
class Figure:
    """A person.

    Attributes:
        build: build of the body.
        height: height without shoes and hair, m.
        skin: one of ``SKINS``.
        hair: one of ``HAIRS``.
        cut: "short", "cropped", "bald", "long" or "bun".
        beard: whether the person has a beard.
        outfit: clothes.
        style: style of the walk.
        split: "train" or "test".
    """

    build: Build
    height: float
    skin: str
    hair: str
    outfit: Outfit
    cut: str = "short"
    beard: bool = False
    style: Style = field(default_factory=Style)
    split: str = "train"


_AFRICAN, _ASIAN, _CAUCASIAN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_MIXED, _EURASIAN = (0.5, 0.0, 0.5), (0.0, 0.5, 0.5)

WHITE, BLACK, GREY, DARK = (236, 236, 232), (28, 28, 30), (122, 124, 126), (66, 68, 72)
JEANS, NAVY, KHAKI, BROWN = (62, 84, 122), (34, 42, 70), (150, 134, 98), (92, 66, 46)
RED, GREEN, BLUE, YELLOW = (190, 32, 36), (46, 120, 62), (40, 88, 186), (232, 200, 44)
ORANGE, PINK, TURQUOISE, PURPLE = (232, 112, 26), (222, 120, 152), (40, 160, 168), (104, 56, 130)
OLIVE, BEIGE, WINE, SKY = (84, 92, 56), (204, 188, 158), (108, 26, 42), (146, 188, 220)
LIME, RUST, TEAL, LILAC = (176, 214, 52), (158, 78, 42), (20, 92, 98), (180, 160, 208)

_AF_AS, _EURO_AF = (0.5, 0.5, 0.0), (0.3, 0.0, 0.7)

TRAIN: dict[str, Figure] = {
    "adam": Figure(Build(1.0, 0.45, 0.55, 0.5, _CAUCASIAN), 1.80, "light", "brown",
                   Outfit(Cloth(RED), Cloth(JEANS), sleeve=0.65)),
    "bela": Figure(Build(0.0, 0.45, 0.5, 0.45, _CAUCASIAN), 1.66, "pale", "fair",
                   Outfit(Cloth(BLUE), Cloth(WHITE), sleeve=0.5, skirt=0.45, shoes=WHITE), cut="long"),
    "chen": Figure(Build(1.0, 0.5, 0.45, 0.4, _ASIAN), 1.70, "light", "black",
                   Outfit(Cloth(WHITE, "stripes", NAVY, 0.09), Cloth(KHAKI), leg=0.85, loose=0.016, shoes=WHITE)),
    "dana": Figure(Build(0.0, 0.55, 0.5, 0.55, _AFRICAN), 1.72, "dark", "black",
                   Outfit(Cloth(YELLOW), Cloth(BLACK), sleeve=0.4, shoes=RED), cut="bun"),
    "emil": Figure(Build(1.0, 0.75, 0.45, 0.75, _CAUCASIAN), 1.76, "pale", "grey",
                   Outfit(Cloth(OLIVE), Cloth(BROWN), thick=0.022, shoes=BROWN, hat="cap", hat_colour=OLIVE),
                   style=Style(stride=0.68, lean=6.0)),
    "fatu": Figure(Build(0.0, 0.5, 0.5, 0.7, _AFRICAN), 1.63, "brown", "black",
                   Outfit(Cloth(PURPLE, "checks", ORANGE, 0.14), Cloth(PURPLE), sleeve=1.2, skirt=0.8), cut="bun"),
    "gino": Figure(Build(1.0, 0.5, 0.7, 0.5, _CAUCASIAN), 1.84, "olive", "black",
                   Outfit(Cloth(GREY), Cloth(DARK), vest=ORANGE, hat="helmet", hat_colour=YELLOW, boots=True,
                          shoes=BROWN, loose=0.014), beard=True),
    "hana": Figure(Build(0.0, 0.4, 0.5, 0.35, _ASIAN), 1.58, "light", "black",
                   Outfit(Cloth(PINK), Cloth(JEANS), thick=0.012, shoes=WHITE, backpack=TURQUOISE), cut="long"),
    "ivan": Figure(Build(1.0, 0.4, 0.85, 0.6, _CAUCASIAN), 1.95, "light", "fair",
                   Outfit(Cloth(BLACK), Cloth(GREY), leg=0.9, sleeve=0.1, loose=0.02, shoes=BLACK), cut="cropped",
                   style=Style(swing=30.0)),
    "jada": Figure(Build(0.0, 0.45, 0.6, 0.4, _MIXED), 1.75, "brown", "brown",
                   Outfit(Cloth(BLACK), Cloth(BLACK), thick=0.005, loose=0.004, sleeve=1.1, leg=1.6, shoes=LIME),
                   cut="bun", style=Style(stride=0.80, swing=30.0, elbow=30.0)),
    "kofi": Figure(Build(1.0, 0.6, 0.5, 0.6, _AFRICAN), 1.78, "dark", "black",
                   Outfit(Cloth(WHITE), Cloth(NAVY), sleeve=2.0, tucked=True, shoes=BLACK), cut="cropped"),
    "lena": Figure(Build(0.0, 0.6, 0.45, 0.6, _CAUCASIAN), 1.69, "pale", "red",
                   Outfit(Cloth(TEAL), Cloth(BEIGE), thick=0.02, open=WHITE, shoes=BROWN), cut="long"),
    "mori": Figure(Build(1.0, 0.85, 0.4, 0.45, _ASIAN), 1.62, "olive", "white",
                   Outfit(Cloth(BEIGE), Cloth(KHAKI), thick=0.014, hat="sunhat", hat_colour=BEIGE, shoes=BROWN),
                   style=Style(stride=0.60, swing=16.0, lean=8.0)),
    "nora": Figure(Build(0.0, 0.8, 0.45, 0.65, _CAUCASIAN), 1.57, "pale", "white",
                   Outfit(Cloth(LILAC, "checks", WHITE, 0.10), Cloth(GREY), skirt=0.62, shoes=DARK), cut="bun",
                   style=Style(stride=0.60, swing=16.0, lean=6.0)),
    "omar": Figure(Build(1.0, 0.5, 0.5, 0.85, _EURO_AF), 1.74, "olive", "black",
                   Outfit(Cloth(SKY, "pinstripes", WHITE, 0.06), Cloth(BROWN), sleeve=0.7, shoes=BROWN), beard=True,
                   cut="bald", style=Style(stride=0.68, width=0.10)),
    "pema": Figure(Build(0.0, 0.5, 0.5, 0.5, _ASIAN), 1.61, "light", "brown",
                   Outfit(Cloth(RED), Cloth(BLACK), thick=0.026, hat="beanie", hat_colour=WHITE, shoes=BLACK,
                          boots=True)),
    "rolf": Figure(Build(1.0, 0.65, 0.6, 0.55, _CAUCASIAN), 1.88, "light", "grey",
                   Outfit(Cloth(BLUE), Cloth(DARK), thick=0.022, boots=True, loose=0.014, shoes=BLACK, hat="cap",
                          hat_colour=RED, backpack=DARK)),
    "sara": Figure(Build(0.0, 0.38, 0.5, 0.4, _EURASIAN), 1.64, "olive", "brown",
                   Outfit(Cloth(WHITE, "stripes", RED, 0.10), Cloth(BLUE), sleeve=0.5, leg=0.55, loose=0.012,
                          shoes=WHITE), cut="long"),
}  # fmt: skip

# No person of the test split shares clothes or build with one of the training split.
TEST: dict[str, Figure] = {
    "tomo": Figure(Build(1.0, 0.42, 0.55, 0.45, _ASIAN), 1.77, "light", "black",
                   Outfit(Cloth(TURQUOISE), Cloth(BEIGE), sleeve=0.55, shoes=NAVY), split="test"),
    "ulla": Figure(Build(0.0, 0.5, 0.55, 0.6, _CAUCASIAN), 1.73, "light", "fair",
                   Outfit(Cloth(WINE), Cloth(NAVY), thick=0.020, shoes=BROWN, backpack=OLIVE), cut="bun", split="test"),
    "vito": Figure(Build(1.0, 0.7, 0.5, 0.7, _CAUCASIAN), 1.71, "olive", "grey",
                   Outfit(Cloth(GREEN, "checks", BLACK, 0.12), Cloth(JEANS), tucked=True, hat="sunhat",
                          hat_colour=KHAKI, shoes=BROWN), beard=True, split="test", style=Style(stride=0.66)),
    "wuli": Figure(Build(0.0, 0.45, 0.5, 0.45, _AF_AS), 1.60, "brown", "black",
                   Outfit(Cloth(ORANGE), Cloth(TEAL), sleeve=0.45, skirt=0.55, shoes=BEIGE), cut="long", split="test"),
    "xola": Figure(Build(1.0, 0.48, 0.75, 0.5, _AFRICAN), 1.86, "dark", "black",
                   Outfit(Cloth(NAVY), Cloth(OLIVE), vest=LIME, hat="helmet", hat_colour=WHITE, boots=True,
                          shoes=BLACK, loose=0.014), cut="cropped", split="test"),
    "yann": Figure(Build(1.0, 0.36, 0.45, 0.35, _CAUCASIAN), 1.82, "pale", "red",
                   Outfit(Cloth(PINK, "stripes", GREY, 0.12), Cloth(RUST), sleeve=0.7, leg=0.9, loose=0.018,
                          shoes=YELLOW), split="test", style=Style(swing=28.0)),
    "zita": Figure(Build(0.0, 0.9, 0.4, 0.55, _EURASIAN), 1.55, "olive", "grey",
                   Outfit(Cloth(BROWN), Cloth(GREY), thick=0.024, shoes=BLACK), cut="short", split="test",
                   style=Style(stride=0.58, swing=14.0, lean=8.0)),
}  # fmt: skip

PEOPLE = TRAIN | TEST
