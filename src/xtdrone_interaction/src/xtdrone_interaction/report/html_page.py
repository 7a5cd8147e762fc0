"""A report: a page with its figures inside, these as PNG, the metrics as JSON, and the tables on the terminal."""

from __future__ import annotations

import base64
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import jinja2
from rich.console import Console
from rich.markup import escape

from xtdrone_common.files import write_whole
from xtdrone_interaction.pictures.picture_style import NamedFigure, save_figures
from xtdrone_interaction.report.report_json import write_report
from xtdrone_interaction.report.report_tables import ReportTable, print_table

_DPI = 120
_TEMPLATE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{{ page.title }}</title>
<style>
body { font: 15px/1.45 sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; margin: 0.6rem 0; } caption { text-align: left; color: #555; }
th, td { padding: 0.15rem 0.7rem; text-align: right; border-bottom: 1px solid #eee; vertical-align: top; }
th:first-child, td:first-child { text-align: left; } tbody tr:hover { background: #f6f8fa; }
th.text, td.text { text-align: left; } td.text { overflow-wrap: anywhere; }
ul.notes { background: #fff7e0; padding: 0.6rem 2rem; } ul.missed { background: #fde8e6; padding: 0.6rem 2rem; }
img, video { max-width: 100%; }
nav { display: flex; flex-wrap: wrap; gap: 0 0.9rem; margin-bottom: 0.8rem; } nav a { white-space: nowrap; }
details summary { cursor: pointer; }
</style>
</head>
<body>
<h1>{{ page.title }}</h1>
{% for line in page.summary.splitlines() %}<p>{{ line }}</p>
{% endfor %}
{% if page.missed %}<ul class="missed">
{%- for text in page.missed %}<li>{{ text }}</li>{% endfor %}</ul>{% endif %}
{% if page.notes %}<ul class="notes">{% for note in page.notes %}<li>{{ note }}</li>{% endfor %}</ul>{% endif %}
<nav>{% for title, name, _ in images %}<a href="#{{ name }}">{{ title }}</a>{% endfor %}
{%- if files %}<a href="#files">Files</a>{% endif %}</nav>
{% for table in page.tables %}
<details{% if not table.long %} open{% endif %}><summary><h2 style="display:inline">{{ table.title }}</h2></summary>
<table>
<thead><tr>
{%- for cell in table.head %}<th{% if loop.index0 in table.texts %} class="text"{% endif %}>{{ cell }}</th>{% endfor -%}
</tr></thead>
<tbody>{% for row in table.rows %}
<tr>{% for cell in row %}<td{% if loop.index0 in table.texts %} class="text"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{%- endfor %}
</tbody></table></details>
{% endfor %}
{% for title, name, data in images %}
<h2 id="{{ name }}">{{ title }}</h2>
<img src="data:image/png;base64,{{ data }}" alt="{{ title }}">
{% endfor %}
{% if files %}
<h2 id="files">Files</h2>
{% for name in files if name.endswith((".mp4", ".gif")) %}
{% if name.endswith(".mp4") %}<video controls preload="metadata" src="{{ name }}"></video>
{% else %}<img src="{{ name }}" alt="{{ name }}">{% endif %}
{% endfor %}
<ul>{% for name in files %}<li><a href="{{ name }}">{{ name }}</a></li>{% endfor %}</ul>
{% endif %}
</body>
</html>
"""


@dataclass
class ReportPage:
    """A report without its figures.

    Attributes:
        title: Title of the page.
        summary: Sentences, each paragraph on a line.
        notes: Reasons for doubt, as sentences.
        tables: Tables, in order.
        missed: Where the flight fell short, as sentences.
        files: Further files of the flight, which the page shows (films) or links; those that are missing are left out.
    """

    title: str
    summary: str
    notes: list[str] = field(default_factory=list)
    tables: list[ReportTable] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


def write_page(
    page: ReportPage,
    metrics: object,
    figures: Iterable[NamedFigure],
    folder: Path,
    console: Console,
    film: Callable[[], Path | None] | None = None,
) -> None:
    """Write ``report.html``, ``report.json`` and the figures into a folder, and print the paths.

    Args:
        page: Everything but the figures.
        metrics: Plain data.
        figures: Figures, each drawn when the iterator is advanced.
        folder: An existing folder.
        console: Console that shows the paths.
        film: Makes a film of the flight after the figures, and returns its file.
    """
    html, data = folder / "report.html", folder / "report.json"
    write_report(metrics, data)  # first, in case a later step fails
    saved = save_figures(figures, folder, _DPI)
    made = film() if film is not None else None
    files = [path for path in dict.fromkeys([*([made] if made else []), *page.files]) if path.exists()]
    images = [(title, path.stem, base64.b64encode(path.read_bytes()).decode()) for title, path in saved]
    template = jinja2.Environment(autoescape=True).from_string(_TEMPLATE)
    links = [os.path.relpath(path, folder) for path in files]
    write_whole(html, template.render(page=page, images=images, files=links))
    print_paths([html, data, *(path for _, path in saved), *files], console)


def print_page(page: ReportPage, console: Console) -> None:
    """Print a report without its long tables."""
    console.print(f"[bold]{escape(page.title)}[/bold]", highlight=False)
    for table in page.tables:
        if table.rows and not table.long:
            print_table(table, console)
    console.print(escape(page.summary), highlight=False, soft_wrap=True)
    for text in page.missed:
        console.print(f"[red]Missed:[/red] {escape(text)}", highlight=False, soft_wrap=True)
    for note in page.notes:
        console.print(f"[yellow]Note:[/yellow] {escape(note)}", highlight=False, soft_wrap=True)


def print_paths(paths: Iterable[Path], console: Console) -> None:
    """Print the paths of results, one per line."""
    for path in paths:
        console.print(f"  {path}", highlight=False, soft_wrap=True, markup=False)
