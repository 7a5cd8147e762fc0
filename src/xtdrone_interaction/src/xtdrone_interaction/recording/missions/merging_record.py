"""What map_merging.py reported in a recorded flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.recorded_flight import RecordError

_TOPIC = "/diagnostics"
_STATUS = ": map merging"  # after the vehicle's name


def read_merging(bag: Path, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return by vehicle: whether its map was ``merged`` at the end, the last ``state``, and ``since`` when.

    ``since`` is the time, s, from which on the map was merged until the end; None without. Vehicles that were not
    reported are left out.

    Raises:
        RecordError: the bag cannot be read.
    """
    try:
        recording = read_bag([bag], wanted=lambda name: name == _TOPIC, keep=[_TOPIC])
    except BagError as error:
        raise RecordError(str(error)) from error
    found: dict[str, dict[str, Any]] = {}
    wanted = {f"{name}{_STATUS}": name for name in names}
    for time, message in recording.messages.get(_TOPIC, []):
        for status in message.status:
            if status.name not in wanted:
                continue
            entry = found.setdefault(wanted[status.name], {"since": None})
            entry["merged"], entry["state"] = status.level == 0, status.message
            if not entry["merged"]:
                entry["since"] = None
            elif entry["since"] is None:
                entry["since"] = round(time, 3)
    return {name: found[name] for name in names if name in found}
