"""Figures of a cooperative search: the find and its error, the area covered, the following. No ROS is needed."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from xtdrone_interaction.report import versions
from xtdrone_interaction.search_record import CUT_SHORT, SearchRecord, Sight

ERROR_LIMIT = 2.0  # m, of a find's place
FOLLOW_IN_VIEW = 0.9  # least part of a follower's pictures that show the person


def make_report(record: SearchRecord, settings: dict[str, Any]) -> dict[str, Any]:
    """Return all figures of a search, ready for JSON.

    Args:
        record: the search.
        settings: how it was started; goes into the report as it is. Its ``wall_time`` (s), where given, makes the
            real-time factor.
    """
    end = record.finished
    finds = _finds(record)
    report: dict[str, Any] = {
        "outcome": end["outcome"],
        "reason": end.get("reason", ""),
        "find": finds[0] if finds else None,
        "finds": finds,
        "following": _following(record),
        "covered": {
            "area": end.get("covered_area"),
            "region_area": end.get("region_area"),
            "fraction": end.get("covered_fraction"),
        },
        "possible": end.get("possible", []),
        "lost": end.get("lost", []),
        "silent_cameras": [event["vehicle"] for event in record.events if event["event"] == "camera_silent"],
        "rejected": sum(event["event"] == "rejected" for event in record.events),
        "second_looks": sum(event["event"] == "second_look" for event in record.events),
        "simulated_time": float(record.time[-1]),
        "vehicles": {name: _vehicle(record, index) for index, name in enumerate(record.names)},
        "collisions": record.collisions,
        "settings": settings,
        "versions": versions(),
    }
    report["shortcomings"] = shortcomings(report, sorted(record.persons))
    return report


def _finds(record: SearchRecord) -> list[dict[str, Any]]:
    """Return who found what, when and where, how far from the nearest person, and whether he had been found before."""
    finds: list[dict[str, Any]] = []
    known: set[str] = set()
    for event in record.events:
        if event["event"] != "confirmed":
            continue
        time = float(event["found_time"])
        place = (float(event["position"][0]), float(event["position"][1]))
        person, error = record.nearest_person(place, time) or (None, None)
        finds.append(
            {
                "vehicle": event["vehicle"],
                "time": time,
                "position": list(place),
                "covariance": event.get("covariance"),
                "person": person,
                "error": error,
                "again": person in known,
            }
        )
        if person is not None and error is not None and error <= ERROR_LIMIT:
            known.add(person)
    return finds


def _following(record: SearchRecord) -> list[dict[str, Any]]:
    """Return how long each following lasted, and which part of its pictures showed the person."""
    result = []
    for begin in (event for event in record.events if event["event"] == "following"):
        ends = [e["time"] for e in record.events if e["time"] > begin["time"] and _ends(e, begin["vehicle"])]
        end = ends[0] if ends else record.finished["time"]
        sights = [s for s in record.sights[begin["vehicle"]] if begin["time"] <= s.time <= end]
        result.append(
            {
                "vehicle": begin["vehicle"],
                "start": begin["time"],
                "duration": end - begin["time"],
                "in_view": _part(sights),
            }
        )
    return result


def _ends(event: dict[str, Any], vehicle: str) -> bool:
    return event["event"] in ("follow_ended", "finished") and event.get("vehicle", vehicle) == vehicle


def _part(sights: list[Sight]) -> float | None:
    return float(np.mean([bool(s.seen) for s in sights])) if sights else None


def _vehicle(record: SearchRecord, index: int) -> dict[str, Any]:
    name = record.names[index]
    way = record.position[:, index]
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    sights = record.sights[name]
    return {
        "distance": float(np.nansum(steps)),
        "greatest_height": float(np.nanmax(way[:, 2])),
        "pictures": len(sights),
        "dropped": sights[-1].dropped if sights else 0,
    }


def shortcomings(report: dict[str, Any], persons: list[str]) -> list[str]:
    """Return what is not as it should be, in words; empty for a good search.

    Args:
        report: its figures.
        persons: who was to be found; where the search goes on after a find, everybody.
    """
    found = []
    if report["outcome"] == "failed":
        found.append(f"the search failed: {report['reason']}")
    if report["outcome"] == CUT_SHORT:
        found.append("the search was cut short")
    if report["outcome"] == "not found" and persons:
        there = "there is a person" if len(persons) == 1 else f"there are {len(persons)} persons"
        found.append(f"nobody was found, and {there}")
    for find in report["finds"]:
        if find["error"] is None or find["error"] > ERROR_LIMIT:
            off = f"the nearest person was {find['error']:.1f} m away" if find["person"] else "nobody is there at all"
            found.append(f"what {find['vehicle']} found is no person: {off}")
    met = {find["person"] for find in report["finds"] if find["person"] and find["error"] <= ERROR_LIMIT}
    missed = [name for name in persons if name not in met]
    if report["outcome"] == "found" and missed and report["settings"].get("on_find") == "continue":
        found.append(f"not found: {', '.join(missed)}")
    for following in report["following"][:1]:
        if following["in_view"] is not None and following["in_view"] < FOLLOW_IN_VIEW:
            found.append(
                f"{following['vehicle']} had the person in view in {100 * following['in_view']:.0f} % of its pictures"
            )
    if report["lost"]:
        found.append(f"lost: {', '.join(report['lost'])}")
    if report["silent_cameras"]:
        found.append(f"silent cameras: {', '.join(report['silent_cameras'])}")
    if report["collisions"]:
        found.append(f"{len(report['collisions'])} collisions")
    return found


def _words_of(find: dict[str, Any]) -> str:
    x, y = find["position"]
    error = "" if find["error"] is None else f", {find['error']:.2f} m from {find['person']}"
    again = " again" if find["again"] else ""
    return f"[green]Found{again}[/green] by {find['vehicle']} at {find['time']:.1f} s, at ({x:.1f}, {y:.1f}) m{error}."


def print_report(report: dict[str, Any], console: Console) -> None:
    """Print the figures that a user wants to see first."""
    covered = report["covered"]
    if report["outcome"] != "found":
        outcome = escape(report["outcome"].capitalize())
        console.print(f"[yellow]{outcome}.[/yellow] {escape(report['reason'])}", highlight=False)
    for find in report["finds"]:
        console.print(_words_of(find), highlight=False)
    for following in report["following"]:
        part = (
            "" if following["in_view"] is None else f", in view in {100 * following['in_view']:.0f} % of the pictures"
        )
        console.print(f"{following['vehicle']} followed for {following['duration']:.0f} s{part}.", highlight=False)
    for candidate in report["possible"][:5]:
        x, y = candidate["position"][:2]
        console.print(
            f"Seen but not confirmed: ({x:.1f}, {y:.1f}) m, {candidate.get('hits', 0)} pictures.", highlight=False
        )
    console.print(_vehicle_table(report), highlight=False)
    if covered["fraction"] is not None:
        area = "" if covered["area"] is None else f"{covered['area']:.0f} of {covered['region_area']:.0f} m^2, "
        console.print(
            f"Covered {area}{100 * covered['fraction']:.1f} %, in {report['simulated_time']:.0f} s{_pace(report)}.",
            highlight=False,
        )
    for line in report["shortcomings"]:
        console.print(f"[red]{escape(line)}[/red]", highlight=False)


def _pace(report: dict[str, Any]) -> str:
    wall = report["settings"].get("wall_time")
    return f", {report['simulated_time'] / wall:.2f} x real time with starting up" if wall else ""


def _vehicle_table(report: dict[str, Any]) -> Table:
    table = Table(box=box.SIMPLE, title="Vehicles", title_justify="left")
    for heading in ("vehicle", "way (m)", "top (m)", "pictures", "passed over"):
        table.add_column(heading, justify="left" if heading == "vehicle" else "right")
    for name, figures in report["vehicles"].items():
        table.add_row(
            name, f"{figures['distance']:.0f}", f"{figures['greatest_height']:.1f}",
            str(figures["pictures"]), str(figures["dropped"]),
        )  # fmt: skip
    return table
