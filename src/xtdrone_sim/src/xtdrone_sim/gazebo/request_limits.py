"""Limits of requests to the simulated world: finite numbers in bounds, names, models of bounded size."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from xtdrone_common.rotation import Quaternion, Vector

FARTHEST = 1e5  # m, along each axis
FASTEST = 1e3  # m/s and rad/s
STRONGEST = 1e6  # N and N m
HARDEST = 1e4  # m/s^2, of a body by the force of a request
HARDEST_TURN = 1e5  # rad/s^2, of a body by the torque of a request
MOST_WRENCHES = 1000  # that act now or later
LONGEST_TEXT = 1 << 20  # characters of a model's description
MOST_ADDED = 500  # models added by requests at one time
_WORST_LENGTH = 0.1  # by which the length of a quaternion may differ from 1
_NAME = re.compile(r"[A-Za-z0-9_.+\-]{1,100}")
_RESERVED = ("world", "map", "ground_plane")
_LISTED = 20  # names in a message


class RequestError(ValueError):
    """A rejected request; the message is one sentence for its sender."""


def check_vector(what: str, values: Sequence[float], most: float) -> Vector:
    """Return three finite numbers of at most ``most``.

    Raises:
        RequestError: a number is not finite or too large.
    """
    x, y, z = (float(value) for value in values)
    if not all(math.isfinite(value) and abs(value) <= most for value in (x, y, z)):
        raise RequestError(f"{what}: ({x:g}, {y:g}, {z:g}) is not allowed, finite numbers from {-most:g} to {most:g}")
    return (x, y, z)


def check_wrench(name: str, force: Vector, torque: Vector, mass: float, moments: Sequence[float]) -> None:
    """Check a wrench against the body on which it is to act.

    Args:
        name: name of the body.
        force: N, at the centre of mass.
        torque: N m.
        mass: kg.
        moments: principal moments of inertia, kg m^2; the smallest one limits the torque.

    Raises:
        RequestError: the wrench would accelerate the body by more than ``HARDEST`` or ``HARDEST_TURN``.
    """
    least = min(moments)
    for what, vector, most, unit, of in (
        ("force", force, mass * HARDEST, "N", f"{mass:.4g} kg"),
        ("torque", torque, least * HARDEST_TURN, "N m", f"moments of inertia from {least:.3g} kg m^2"),
    ):
        size = math.hypot(*vector)
        if not size <= most:
            raise RequestError(
                f"wrench: {what}: {size:.4g} {unit} on {name!r} is not allowed, at most {most:.3g} {unit} with {of}"
            )


def check_quaternion(what: str, values: Sequence[float]) -> Quaternion:
    """Return a quaternion (w, x, y, z) of length 1; four zeros, of an unset message, are no rotation, as in Gazebo.

    Raises:
        RequestError: the length differs from 1 by more than a rounding.
    """
    w, x, y, z = (float(value) for value in values)
    if w == x == y == z == 0.0:
        return (1.0, 0.0, 0.0, 0.0)
    length = math.hypot(w, x, y, z)
    if not abs(length - 1.0) <= _WORST_LENGTH:
        raise RequestError(f"{what}: (x {x:g}, y {y:g}, z {z:g}, w {w:g}) is not allowed, a quaternion of length 1")
    return (w / length, x / length, y / length, z / length)


def check_name(what: str, name: str) -> str:
    """Return a name for a model.

    Raises:
        RequestError: it is empty, too long or reserved, or has characters other than letters, digits and ``_ . + -``.
    """
    if not _NAME.fullmatch(name) or name in _RESERVED:
        shown = name if len(name) <= 100 else name[:100] + "..."
        raise RequestError(
            f"{what}: {shown!r} is not allowed, 1 to 100 letters, digits and _ . + -, other than {', '.join(_RESERVED)}"
        )
    return name


def unknown(what: str, name: str, known: Sequence[str]) -> RequestError:
    """Return the error for a name that does not exist."""
    names = ", ".join(known[:_LISTED]) + (f" and {len(known) - _LISTED} more" if len(known) > _LISTED else "")
    shown = name if len(name) <= 100 else name[:100] + "..."
    return RequestError(f"{what}: {shown!r} does not exist; there are {names}")
