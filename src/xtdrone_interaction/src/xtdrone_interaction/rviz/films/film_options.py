"""Options of ``./xtdrone record-view``."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from xtdrone_common.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError, checked
from xtdrone_interaction.rviz.view_configurations import SHIPPED

DEMOS = ("formation", "simplified", "search")
_RATES = (1.0, 50.0)  # allowed frames per simulated second
_SIZES = (64, 4096)  # pixels


@dataclass(frozen=True, kw_only=True)
class FilmSettings(Settings):
    """Settings of a film.

    Attributes:
        view: one of SHIPPED, or an .rviz file.
        bag: recorded flight; None for the running flight.
        demo: name of a demo to fly first, with ``bag`` None; empty for none.
        demo_options: options of the demo.
        world: of a bag, name or absolute path; empty: the one that its results folder names, else none.
        size: width and height, px.
        out: file of the film.
        frames: folder for PNG files, or None.
        master: port or URI of the running flight; empty for automatic.
        again: the film is drawn for the second time, after a crash.
    """

    view: str
    bag: Path | None
    demo: str
    demo_options: tuple[str, ...]
    world: str
    fps: float = setting(30.0, above=0.0, metavar="N", text="frames per second of the film")
    faster: float = setting(1.0, above=0.0, metavar="N", text="simulated seconds per second of the film")
    size: tuple[int, int]
    begin: float = setting(
        0.0, option="--from", metavar="S", unit="s", text="of a bag: simulated time of the first frame"
    )
    end: float = setting(
        math.inf,
        high=math.inf,
        option="--to",
        metavar="S",
        unit="s",
        text="of a bag: simulated time of the last frame",
    )
    antialiasing: bool = setting(True, option="--rough", text="do not smooth edges: drawn in about half the time")
    out: Path
    frames: Path | None
    master: str
    again: bool = False

    @property
    def rate(self) -> float:
        """Frames per simulated second."""
        return self.fps / self.faster


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(_SIZES[0] <= side <= _SIZES[1] for side in size):
        raise OptionError(f"size: {text!r} is not allowed; WIDTHxHEIGHT, each {_SIZES[0]} to {_SIZES[1]}, as 1280x720")
    return size


def _frames(folder: Path | None, *, again: bool) -> Path | None:
    """Return the folder of the frames, which the first drawing has made for the second."""
    return folder if again or folder is None else command_options.new_folder(folder)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Film a flight with rviz, without a screen: a recorded flight, a demo that is flown first, or the running "
        "flight. Options of the demo follow --."
    )
    add = parser.add_argument
    add("view", metavar="VIEW", help=f"{', '.join(SHIPPED)} (adapted to the fleet), or an .rviz file")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--bag", type=Path, metavar="FILE", help="flight.bag of a run")
    source.add_argument("--demo", choices=DEMOS, help="fly this demo, then film it")
    add("--out", type=Path, metavar="FILM", help="ends with .mp4 (default: VIEW.mp4 beside the bag, else here)")
    FilmSettings.add_arguments(parser, ("fps", "faster"))
    add("--size", type=checked(_size), default=(1280, 720), metavar="WxH", help="pixels (default: 1280x720)")
    FilmSettings.add_arguments(parser, ("antialiasing", "begin", "end"))
    add("--world", metavar="WORLD",
        help="world to show with a bag, by name or file (default: the one that the bag's folder names)")  # fmt: skip
    add("--frames", type=Path, metavar="FOLDER", help="also write each frame as a PNG file into a new folder")
    add("--again", action="store_true", help=argparse.SUPPRESS)
    add("--master", default="", metavar="PORT|URI", help="port or URI of the running flight (default: automatic)")


def as_words(settings: FilmSettings) -> list[str]:
    """Return the command line that draws the film of a bag a second time; see :func:`settings_of`."""
    words = [
        settings.view,
        f"--bag={settings.bag}",
        f"--out={settings.out}",
        f"--fps={settings.fps!r}",
        f"--faster={settings.faster!r}",
        f"--size={settings.size[0]}x{settings.size[1]}",
        f"--from={settings.begin!r}",
        f"--to={settings.end!r}",
        "--again",
    ]
    words += ["--rough"] * (not settings.antialiasing)
    words += [f"--world={settings.world}"] * bool(settings.world)
    return words + [f"--frames={settings.frames}"] * (settings.frames is not None)


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parse a command line; the words after ``--`` are kept in ``demo_options``."""
    own = list(words)
    cut = own.index("--") if "--" in own else len(own)
    arguments = parser.parse_args(own[:cut])
    arguments.demo_options = own[cut + 1 :]
    return arguments


def film_settings(argv: Sequence[str]) -> FilmSettings:
    """Return the settings of a command line; see :func:`settings_of`.

    Args:
        argv: options, and those of the demo after ``--``.

    Raises:
        OptionError: invalid value.
        SystemExit: from argparse.
    """
    parser = argparse.ArgumentParser(prog="xtdrone record-view")
    add_arguments(parser)
    return settings_of(parse(parser, argv))


def settings_of(arguments: argparse.Namespace) -> FilmSettings:
    """Return the settings of the film, after all checks that need no ROS.

    Raises:
        OptionError: a value that is not allowed.
    """
    demo_options = arguments.demo_options
    view = arguments.view
    name = Path(view).stem if view.endswith(".rviz") and not Path(view).is_file() else view
    if name not in SHIPPED:
        if not Path(view).is_file():
            raise OptionError(f"view: {view!r} is neither an .rviz file nor one of {', '.join(SHIPPED)}")
        name = str(Path(view).resolve())
    if demo_options and not arguments.demo:
        raise OptionError(f"{demo_options[0]!r}: options of a demo are for --demo only")
    if arguments.world and arguments.bag is None:
        raise OptionError("world: --world is for --bag only; other flights are shown in their own world")
    if arguments.bag is not None and not arguments.bag.is_file():
        raise OptionError(f"bag: {arguments.bag} does not exist")
    out = arguments.out or (arguments.bag.parent if arguments.bag else Path()) / f"{Path(name).stem}.mp4"
    if out.suffix != ".mp4":
        raise OptionError(f"out: {str(out)!r} is not allowed; a film ends with .mp4")
    if not out.resolve().parent.is_dir():
        raise OptionError(f"out: {out.resolve().parent} is no folder")
    settings = FilmSettings.from_arguments(
        arguments,
        view=name,
        bag=arguments.bag,
        demo=arguments.demo or "",
        demo_options=tuple(demo_options),
        world=command_options.world(arguments.world) if arguments.world else "",
        size=arguments.size,
        out=out.resolve(),
        frames=_frames(arguments.frames, again=arguments.again),
        master=arguments.master,
        again=arguments.again,
    )
    if not settings.begin < settings.end:
        raise OptionError(f"from, to: {settings.begin:g} s is not before {settings.end:g} s")
    if not _RATES[0] <= settings.rate <= _RATES[1]:
        raise OptionError(
            f"fps, faster: {settings.rate:g} frames a simulated second are not allowed; {_RATES[0]:g} to {_RATES[1]:g}"
        )
    return settings
