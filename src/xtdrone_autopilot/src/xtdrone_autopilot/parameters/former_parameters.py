"""Parameters of PX4 v1.11 that v1.14 has renamed or removed.

Scripts and parameter files of XTDrone name them: XTDrone flies v1.11.0-beta1. Source: the parameter definitions of PX4
v1.11.0-beta1 and -beta2 against those of v1.14, ``param_translation.cpp`` and the descriptions of the commits that
removed a name. Parameters of other vehicle types, boards and drivers are left out, and so are those of outputs (PWM_*).
"""

from __future__ import annotations

from xtdrone_autopilot.tables.reader import read_table

_REPLACEMENTS = {
    name: tuple(found) for name, found in read_table("former_parameters", {"name": str, "replacements": str.split})
}

NAMES = frozenset(_REPLACEMENTS)
"""All former names. EKF2_AID_MASK still exists in v1.14, without effect here."""


def replacements(name: str) -> tuple[str, ...]:
    """Return the current parameters that replace a former one; empty if it has no successor or is not a former one."""
    return _REPLACEMENTS.get(name, ())


def hint(name: str) -> str:
    """Return a phrase on the successors of a former parameter, for the end of a message; empty for all other names."""
    if name not in NAMES:
        return ""
    if today := replacements(name):
        return f": PX4 v1.14 has {', '.join(today)} in its place"
    return ": PX4 v1.11 had it, v1.14 has nothing in its place"
