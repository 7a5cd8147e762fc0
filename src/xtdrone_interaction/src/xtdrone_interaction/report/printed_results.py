"""The reports of formation flights and searches on the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from xtdrone_interaction.report.report_tables import ReportTable, formation_table, print_table


def print_paths(paths: Iterable[Path], console: Console) -> None:
    """Print the paths of results, one per line."""
    for path in paths:
        console.print(f"  {path}", highlight=False, soft_wrap=True, markup=False)


def print_formation(report: dict[str, Any], console: Console) -> None:
    """Print a formation flight's table and shortcomings.

    Args:
        report: of :func:`~xtdrone_interaction.metrics.missions.formation_metrics.make_report`.
        console: to print on.
    """
    title = f"Formation flight of {len(report['vehicles'])} vehicles"
    print_table(formation_table(report["reconfigurations"], title), console)
    simplified = report["settings"].get("simulator") == "simplified"
    collisions = "" if simplified else f", {len(report['collisions'])} collisions"
    line = f"Minimum distance {report['least_distance']:.2f} m{collisions}; {report['sim_time']:.1f} s simulated"
    if report["real_time_factor"] is not None:
        line += f" in {report['wall_time']:.1f} s ({report['real_time_factor']:.1f} x real time)"
    if report["startup_time"] is not None:
        line += f"; first vehicle armed {report['startup_time']:.1f} s after the command"
    console.print(line + ".", highlight=False)
    console.print(f"Positions: {report['positions']}.", highlight=False)
    if simplified:
        console.print(
            "Simplified vehicles do not collide: where two meet, they fly through each other.", highlight=False
        )
    for text in report["shortcomings"]:
        console.print(f"[red]Missed:[/red] {escape(text)}", highlight=False, soft_wrap=True)


def print_search(report: dict[str, Any], console: Console) -> None:
    """Print a search's finds, table and shortcomings.

    Args:
        report: of :func:`~xtdrone_interaction.metrics.missions.search_metrics.make_report`.
        console: to print on.
    """
    covered = report["covered"]
    if report["outcome"] != "found":
        outcome = escape(report["outcome"].capitalize())
        console.print(f"[yellow]{outcome}.[/yellow] {escape(report['reason'])}", highlight=False)
    for find in report["finds"]:
        console.print(_find_text(find), highlight=False)
    for following in report["following"]:
        share = following["in_view"]
        part = "" if share is None else f", in view in {100 * share:.0f} % of the images"
        console.print(f"{following['vehicle']} followed for {following['duration']:.0f} s{part}.", highlight=False)
    for candidate in report["possible"][:5]:
        x, y = candidate["position"][:2]
        console.print(
            f"Seen but not confirmed: ({x:.1f}, {y:.1f}) m, {candidate.get('hits', 0)} images.", highlight=False
        )
    print_table(_search_table(report["vehicles"]), console)
    if covered["fraction"] is not None:
        area = "" if covered["area"] is None else f"{covered['area']:.0f} of {covered['region_area']:.0f} m^2, "
        console.print(
            f"Covered {area}{100 * covered['fraction']:.1f} %, in {report['simulated_time']:.0f} s{_pace(report)}.",
            highlight=False,
        )
    for line in report["shortcomings"]:
        console.print(f"[red]{escape(line)}[/red]", highlight=False)


def _find_text(find: dict[str, Any]) -> str:
    x, y = find["position"]
    error = "" if find["error"] is None else f", {find['error']:.2f} m from {find['person']}"
    again = " again" if find["again"] else ""
    return f"[green]Found{again}[/green] by {find['vehicle']} at {find['time']:.1f} s, at ({x:.1f}, {y:.1f}) m{error}."


def _pace(report: dict[str, Any]) -> str:
    wall = report["settings"].get("wall_time")
    return f", {report['simulated_time'] / wall:.2f} x real time including start-up" if wall else ""


def _search_table(vehicles: dict[str, dict[str, Any]]) -> ReportTable:
    rows = [
        (
            name,
            f"{item['distance']:.0f}",
            f"{item['greatest_height']:.1f}",
            str(item["pictures"]),
            str(item["dropped"]),
        )
        for name, item in vehicles.items()
    ]
    return ReportTable("Vehicles", ("vehicle", "path (m)", "top (m)", "images", "skipped"), rows)


def print_crossing(report: dict[str, Any], console: Console) -> None:
    """Print the figures of a flight through obstacles.

    Args:
        report: of :func:`~xtdrone_interaction.metrics.missions.crossing_metrics.make_report`.
        console: to print on.
    """
    for name, vehicle in report["vehicles"].items():
        line = f"{name}: {vehicle['outcome']}"
        if "time" in vehicle:
            line += (
                f"; {vehicle['straight']:.1f} m in {vehicle['time']:.1f} s, {vehicle['mean_speed']:.1f} m/s on average "
                f"(straight and without obstacles: {vehicle['straight_time']:.1f} s), path {vehicle['path']:.1f} m"
            )
        if vehicle["clearance"] is not None:
            line += f"; nearest obstacle {vehicle['clearance']:.2f} m from its centre"
        console.print(line + ".", highlight=False, soft_wrap=True, markup=False)
        for kind, words in (("map", "map update"), ("plan", "plan")):
            found = report["timings"].get(name, {}).get(kind)
            if found is not None:
                console.print(
                    f"  {words}: {found['median_ms']:.1f} ms (median of {found['count']}), {found['p95_ms']:.1f} ms "
                    "(95 %), wall time on this machine",
                    highlight=False,
                )
    if report["least_distance"] is not None:
        console.print(f"Minimum distance of two vehicles {report['least_distance']:.2f} m.", highlight=False)
    if report["formation"] is not None:
        _print_formation_errors(report["formation"], console)
    for text in report["shortcomings"]:
        console.print(f"[red]Missed:[/red] {escape(text)}", highlight=False, soft_wrap=True)


def _print_formation_errors(figures: dict[str, Any], console: Console) -> None:
    parts = []
    for key, words in (("before", "before the way"), ("during", "on it"), ("after", "formed again")):
        if figures[key] is not None:
            parts.append(f"{words} {figures[key]['mean']:.2f} m on average, at most {figures[key]['most']:.2f} m")
    if figures["formed_again_after"] is not None:
        parts.append(f"{figures['formed_again_after']:.1f} s after the leader's arrival")
    console.print(f"Formation {figures['pattern']}, error: {'; '.join(parts)}.", highlight=False, soft_wrap=True)


def print_exploration(report: dict[str, Any], console: Console) -> None:
    """Print the figures of an exploration.

    Args:
        report: of :func:`~xtdrone_interaction.metrics.missions.exploration_metrics.make_report`.
        console: to print on.
    """
    for name, vehicle in report["vehicles"].items():
        line = (
            f"{name}: {vehicle['outcome']}; path {vehicle['path']:.1f} m, nearest obstacle {vehicle['clearance']:.2f} m"
        )
        console.print(f"{line} from its centre.", highlight=False, soft_wrap=True, markup=False)
    line = f"Seen: {100 * report['coverage']:.1f} % of the visible floor"
    if report["time_to_95_percent"] is not None:
        line += f", 95 % after {report['time_to_95_percent']:.0f} s"
    if report["explored_after"] is not None:
        line += f", no frontier left after {report['explored_after']:.0f} s"
    console.print(f"{line}.", highlight=False, soft_wrap=True)
    if report["least_distance"] is not None:
        console.print(f"Minimum distance of two vehicles {report['least_distance']:.2f} m.", highlight=False)
    for name, entry in report.get("merging", {}).items():
        if entry["merged"]:
            line = f"Map of {name}: {entry['state']}, since {entry['since']:.0f} s."
            console.print(line, highlight=False, soft_wrap=True, markup=False)
    for text in report["shortcomings"]:
        console.print(f"[red]Missed:[/red] {escape(text)}", highlight=False, soft_wrap=True)
