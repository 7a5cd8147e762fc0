"""Names of patterns: parsing, options and paths of files in them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from .slot_offsets_and_spacing import MAX_SPACING, MIN_SEPARATION, PatternError

ARGUMENTS = {"text": "WORDS", "cloud": "FILE"}
_EXAMPLES = {"text": "XTD", "cloud": "/data/points.ply"}
_OPTION = re.compile(r"[a-z_]+=")


@dataclass(frozen=True)
class PatternRequest:
    """A parsed name of a pattern.

    Attributes:
        kind: the part before the first colon.
        argument: words of a text, file of a cloud; else empty.
        spacing: minimum distance of two vehicles, m; None if not given.
        font: file of a text's font; None if not given.
    """

    kind: str
    argument: str = ""
    spacing: float | None = None
    font: str | None = None

    def __str__(self) -> str:
        """Return the name."""
        parts = [self.kind, *([self.argument] if self.argument else [])]
        parts += [f"font={self.font}"] if self.font is not None else []
        parts += [f"spacing={self.spacing:.12g}"] if self.spacing is not None else []
        return ":".join(parts)


def parse_name(name: str) -> PatternRequest:
    """Parse the name of a pattern without checking that the pattern exists.

    Raises:
        PatternError: an argument or option is missing, unknown or not allowed.
    """
    kind, *parts = name.split(":")
    first = 1 if kind in ARGUMENTS else 0  # the argument may look like an option
    begin = next((i for i in range(first, len(parts)) if _OPTION.match(parts[i])), len(parts))
    argument = ":".join(parts[:begin])
    if kind in ARGUMENTS and not argument:
        raise PatternError(f"{kind} needs {ARGUMENTS[kind]}, as {kind}:{_EXAMPLES[kind]}")
    if kind not in ARGUMENTS and parts[:begin]:
        raise PatternError(f"{argument!r} is not allowed after {kind}, only spacing=METRES is")
    given: dict[str, str] = {}
    for part in parts[begin:]:
        if _OPTION.match(part):
            option, _, value = part.partition("=")
            given[option] = value
        else:  # a colon within a value
            given[option] += f":{part}"
    allowed = ("spacing", "font") if kind == "text" else ("spacing",)
    for option in given:
        if option not in allowed:
            raise PatternError(f"option {option!r} is unknown for {kind}; there are: {', '.join(allowed)}")
    spacing = _spacing(given["spacing"]) if "spacing" in given else None
    return PatternRequest(kind, argument, spacing, given.get("font"))


def absolute_name(name: str) -> str:
    """Return the name with absolute paths of the files in it, because the leader may run in another folder.

    Names other than those of texts and clouds are returned unchanged.
    """
    try:
        request = parse_name(name)
    except PatternError:
        return name  # the error is reported when the pattern is created
    if request.font is not None:
        request = replace(request, font=_absolute(request.font))
    elif request.kind != "cloud":
        return name
    return str(replace(request, argument=_absolute(request.argument)) if request.kind == "cloud" else request)


def _absolute(file: str) -> str:
    return str(Path(file).expanduser().absolute())


def _spacing(value: str) -> float:
    try:
        spacing = float(value)
    except ValueError:
        spacing = math.nan
    if not MIN_SEPARATION <= spacing <= MAX_SPACING:
        raise PatternError(f"spacing: {value!r} is not allowed, {MIN_SEPARATION} to {MAX_SPACING:g} m")
    return spacing
