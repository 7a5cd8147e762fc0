"""Criteria of a good formation flight with their limits, and the choice of those that count."""

from __future__ import annotations

from typing import Any

from xtdrone_common.settings import setting

CRITERIA = {
    "settling": "each pattern settles",
    "steady-error": "the steady error is small",
    "assignment": "the slots are assigned with the minimum total distance",
    "distance": "vehicles keep their distance",
    "collision": "nothing collides",
}
SETTLED_ERROR = 0.15  # m; a follower closer to its slot than this has settled
STEADY_LIMIT = 0.10  # m, of the mean error at the end of a pattern
ASSIGNMENT_SLACK = 0.01  # share of the optimum; the leader's positions are a tick or two older than the recorded ones


def parse_criteria(text: object) -> list[str]:
    """Return the names in a list separated by commas, in the order of ``CRITERIA``.

    Raises:
        ValueError: an unknown name; the text states what is allowed.
    """
    names = {name.strip() for name in str(text).split(",")}
    if not names <= CRITERIA.keys():
        raise ValueError(f"comma-separated names, of {', '.join(CRITERIA)}")
    return [name for name in CRITERIA if name in names]


def waive_setting() -> Any:
    """Declare the criteria of a good flight that do not count."""
    text = f"criteria that do not count for the exit status, with commas between, of {', '.join(CRITERIA)}"
    return setting((), parse=parse_criteria, metavar="NAMES", text=text)
