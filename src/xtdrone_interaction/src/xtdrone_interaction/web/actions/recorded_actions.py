"""Read the operators' actions of a recorded session from its bag."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.bag_kinds import Layouts, by_connection, large_batches, open_sources

TOPIC = "/xtdrone/operator_actions"
LET_GO = "actions.let_go"
"""Method on the topic: an action took so long that time resumed before its end; ``number`` in its parameters."""
REFUSED = "actions.refused"
"""Method on the topic: an action has ended with an error; ``number`` in its parameters."""
_MARKS = (LET_GO, REFUSED)


class ActionError(ValueError):
    """A bag without actions that can be replayed."""


@dataclass(frozen=True)
class RecordedAction:
    """One action on the flight.

    Attributes:
        number: of the actions of its station, from 1.
        tick: at which it took effect.
        time: simulated time of that tick, s.
        exact: whether all of it took effect between this tick and the next.
        refused: whether it ended with an error.
        page: number of the page.
        method: name, as ``vehicles.command``.
        params: of the method.
    """

    number: int
    tick: int
    time: float
    exact: bool
    refused: bool
    page: int
    method: str
    params: Mapping[str, Any]


def read_actions(paths: Iterable[Path]) -> list[RecordedAction]:
    """Return the actions on the flight in bags, in their order.

    Raises:
        ActionError: there are none, earlier ones are missing, or an entry is none of this project's stations.
        BagError: a file is no bag.
    """
    return parse_actions(_texts(list(paths)))


def parse_actions(texts: Iterable[str]) -> list[RecordedAction]:
    """Return the actions on the flight of the topic's texts.

    Raises:
        ActionError: as ``read_actions``.
    """
    entries: list[dict[str, Any]] = []
    marks: set[tuple[str, int, int]] = set()  # method, station and number of the action
    station, last = 0, 0
    for text in texts:
        entry = _entry(text)
        if entry["method"] in _MARKS:
            marks.add((entry["method"], entry["station"], entry["params"]["number"]))
            continue
        if entry["station"] != station:
            station, last = entry["station"], 0
        if entry["number"] <= last:  # without effect on the flight, or repeated for a new subscriber
            continue
        if entry["number"] != last + 1:
            raise ActionError(f"bag: action {last + 1} is missing, the next one in it is {entry['number']}")
        last = entry["number"]
        if entry["tick"] is not None:
            entries.append(entry)
    if not entries:
        raise ActionError(f"bag: it contains no action of an operator on the flight ({TOPIC})")
    return [_action(entry, marks) for entry in entries]


def _action(entry: Mapping[str, Any], marks: Set[tuple[str, int, int]]) -> RecordedAction:
    number, station = entry["number"], entry["station"]
    return RecordedAction(
        number=number,
        tick=entry["tick"],
        time=entry["time"],
        exact=entry["held"] and (LET_GO, station, number) not in marks,
        refused=(REFUSED, station, number) in marks,
        page=entry["page"],
        method=entry["method"],
        params=entry["params"],
    )


def _texts(paths: list[Path]) -> Iterable[str]:
    source = open_sources(paths)
    layouts = Layouts()
    for batch in large_batches(source):
        for number, part in by_connection(batch):
            connection = source.connections[number]
            layout = layouts.of(connection) if connection.topic == TOPIC else None
            if layout is not None:
                yield from layout.decode(part.data, part.offset, part.length, ["data"]).texts("data")


_KINDS: Mapping[str, type | tuple[type, ...]] = {
    "station": int,
    "number": int,
    "tick": (int, type(None)),
    "time": (int, float),
    "held": bool,
    "page": int,
    "method": str,
    "params": dict,
}
_MARK_KINDS = {name: _KINDS[name] for name in ("station", "method", "params")}


def _entry(text: str) -> dict[str, Any]:
    try:
        entry = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ActionError(f"bag: {text[:80]!r} is not an action: {error}") from error
    if not isinstance(entry, dict):
        raise ActionError(f"bag: {text[:80]!r} is not an action, an object is needed")
    is_mark = entry.get("method") in _MARKS
    for name, kind in (_MARK_KINDS if is_mark else _KINDS).items():
        if name not in entry or not isinstance(entry[name], kind):
            raise ActionError(f"bag: {name} of the action {text[:80]!r} is not allowed or missing")
    if is_mark and not isinstance(entry["params"].get("number"), int):
        raise ActionError(f"bag: params of the action {text[:80]!r} is not allowed, the number of an action is needed")
    return entry
