"""Metrics of a cooperative search: finds and their errors, the area covered, the following of a person."""

from __future__ import annotations

from typing import Any

import numpy as np

from xtdrone_interaction.missions.search.record import CUT_SHORT, SearchRecord, Sight
from xtdrone_interaction.report.report_json import versions

ERROR_LIMIT = 2.0  # m, of a find's position
FOLLOW_IN_VIEW = 0.9  # minimum share of a follower's images that show the person


def make_report(record: SearchRecord, settings: dict[str, Any]) -> dict[str, Any]:
    """Return all metrics of a search as plain data.

    Args:
        record: the search.
        settings: of the search, stored as they are; their ``wall_time``, s, gives the real-time factor.
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
    """Return the confirmed finds, each with the nearest person, the distance, and whether it is a repetition."""
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
    """Return the duration of each following, and the share of images that showed the person."""
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
                "in_view": _share_in_view(sights),
            }
        )
    return result


def _ends(event: dict[str, Any], vehicle: str) -> bool:
    return event["event"] in ("follow_ended", "finished") and event.get("vehicle", vehicle) == vehicle


def _share_in_view(sights: list[Sight]) -> float | None:
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
    """Return where the search fell short, as sentences; none for a good one.

    Args:
        report: its metrics.
        persons: in the region. If the search continues after a find, all of them should be found.
    """
    found = []
    if report["outcome"] == "failed":
        found.append(f"the search failed: {report['reason']}")
    if report["outcome"] == CUT_SHORT:
        found.append("the search was cut short")
    if report["outcome"] == "not found" and persons:
        present = "1 person" if len(persons) == 1 else f"{len(persons)} persons"
        found.append(f"no person was found, but the region has {present}")
    for find in report["finds"]:
        if find["error"] is None or find["error"] > ERROR_LIMIT:
            off = f"the nearest person was {find['error']:.1f} m away" if find["person"] else "the world has no persons"
            found.append(f"the find of {find['vehicle']} is not a person: {off}")
    met = {find["person"] for find in report["finds"] if find["person"] and find["error"] <= ERROR_LIMIT}
    missed = [name for name in persons if name not in met]
    if report["outcome"] == "found" and missed and report["settings"].get("on_find") == "continue":
        found.append(f"not found: {', '.join(missed)}")
    for following in report["following"][:1]:
        if following["in_view"] is not None and following["in_view"] < FOLLOW_IN_VIEW:
            found.append(
                f"{following['vehicle']} had the person in view in {100 * following['in_view']:.0f} % of its images"
            )
    if report["lost"]:
        found.append(f"lost: {', '.join(report['lost'])}")
    if report["silent_cameras"]:
        found.append(f"failed cameras: {', '.join(report['silent_cameras'])}")
    if report["collisions"]:
        found.append(f"{len(report['collisions'])} collisions")
    return found
