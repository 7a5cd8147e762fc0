"""Who the people are: builds, skins, hair and clothes; and which are kept for tests of detectors."""

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
    """A cloth's look.

    Attributes:
        colour: of the ground.
        pattern: "plain", "stripes" (level), "pinstripes" (upright) or "checks".
        second: colour of the pattern.
        period: of the pattern, m.
    """

    colour: Rgb
    pattern: str = "plain"
    second: Rgb = (240, 240, 240)
    period: float = 0.08


@dataclass(frozen=True)
class Outfit:
    """What somebody wears.

    Attributes:
        top, bottom: cloths.
        sleeve: how far sleeves go along the arm: 0 shoulder, 1 elbow, 2 wrist.
        leg: how far trousers go along the leg: 0 hip, 1 knee, 2 ankle.
        skirt: length of a skirt in place of trousers, as a share of the way to the ankles; 0 for none.
        thick: of the top, m off the skin.
        loose: of the trousers, m off the skin.
        tucked: whether the top ends at the waist instead of over the hips.
        open: colour of what shows under a jacket that is open in front; None: it is closed.
        vest: colour of a high-visibility vest with bands; None for none.
        shoes: their colour.
        boots: whether they reach up the leg.
        hat: "", "cap", "sunhat", "helmet" or "beanie".
        hat_colour: its colour.
        backpack: its colour; None for none.
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
    """One person.

    Attributes:
        build: of the body.
        height: m, without shoes and hair.
        skin: one of ``SKINS``.
        hair: one of ``HAIRS``.
        cut: "short", "cropped", "bald" or "long".
        beard: whether he has one.
        outfit: clothes.
        style: of the walk.
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

PEOPLE: dict[str, Figure] = {
    "adam": Figure(Build(1.0, 0.45, 0.55, 0.5, _CAUCASIAN), 1.80, "light", "brown",
                   Outfit(Cloth(RED), Cloth(JEANS), sleeve=0.65)),
    "bela": Figure(Build(0.0, 0.45, 0.5, 0.45, _CAUCASIAN), 1.66, "pale", "fair",
                   Outfit(Cloth(BLUE), Cloth(WHITE), sleeve=0.5, skirt=0.45, shoes=WHITE), cut="long"),
    "chen": Figure(Build(1.0, 0.5, 0.45, 0.4, _ASIAN), 1.70, "light", "black",
                   Outfit(Cloth(WHITE, "stripes", NAVY, 0.09), Cloth(KHAKI), leg=0.85, loose=0.016, shoes=WHITE)),
    "dana": Figure(Build(0.0, 0.55, 0.5, 0.55, _AFRICAN), 1.72, "dark", "black",
                   Outfit(Cloth(YELLOW), Cloth(BLACK), sleeve=0.4, shoes=RED)),
    "emil": Figure(Build(1.0, 0.75, 0.45, 0.75, _CAUCASIAN), 1.76, "pale", "grey",
                   Outfit(Cloth(OLIVE), Cloth(BROWN), thick=0.022, shoes=BROWN, hat="cap", hat_colour=OLIVE),
                   style=Style(stride=0.70, lean=6.0)),
    "fatu": Figure(Build(0.0, 0.5, 0.5, 0.7, _AFRICAN), 1.63, "brown", "black",
                   Outfit(Cloth(PURPLE, "checks", ORANGE, 0.14), Cloth(PURPLE), sleeve=1.2, skirt=0.8)),
    "gino": Figure(Build(1.0, 0.5, 0.7, 0.5, _CAUCASIAN), 1.84, "olive", "black",
                   Outfit(Cloth(GREY), Cloth(DARK), vest=ORANGE, hat="helmet", hat_colour=YELLOW, boots=True,
                          shoes=BROWN, loose=0.014), beard=True),
    "hana": Figure(Build(0.0, 0.4, 0.5, 0.35, _ASIAN), 1.58, "light", "black",
                   Outfit(Cloth(PINK), Cloth(JEANS), thick=0.012, shoes=WHITE, backpack=TURQUOISE), cut="long"),
}  # fmt: skip
