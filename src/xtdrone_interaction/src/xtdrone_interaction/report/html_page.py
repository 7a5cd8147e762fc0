"""A report: a self-contained HTML page, its figures as PNG, its metrics as JSON, and its tables on the terminal."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import jinja2
from rich.console import Console
from rich.markup import escape

from xtdrone_control.files import write_whole
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.metrics.missions.formation_metrics import write_report
from xtdrone_interaction.pictures.picture_style import NamedFigure, save_figures
from xtdrone_interaction.report.printed_results import print_paths
from xtdrone_interaction.report.report_tables import ReportTable, print_table

_DPI = 110
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
ul.notes { background: #fff7e0; padding: 0.6rem 2rem; } img { max-width: 100%; }
nav { display: flex; flex-wrap: wrap; gap: 0 0.9rem; margin-bottom: 0.8rem; } nav a { white-space: nowrap; }
details summary { cursor: pointer; }
</style>
</head>
<body>
<h1>{{ page.title }}</h1>
<p>{{ page.summary }}</p>
{% if page.notes %}<ul class="notes">{% for note in page.notes %}<li>{{ note }}</li>{% endfor %}</ul>{% endif %}
<nav>{% for title, name, _ in images %}<a href="#{{ name }}">{{ title }}</a>{% endfor %}</nav>
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
</body>
</html>
"""


@dataclass
class ReportPage:
    """A report without its figures.

    Attributes:
        title: of the page.
        summary: one or two sentences.
        notes: reasons for doubt, as sentences.
        tables: in order.
    """

    title: str
    summary: str
    notes: list[str] = field(default_factory=list)
    tables: list[ReportTable] = field(default_factory=list)


def output_folder(wanted: Path | None, usual: Path) -> Path:
    """Return the folder of results, created if necessary: ``wanted``, else ``usual``.

    Raises:
        OptionError: it cannot be created or written to.
    """
    folder = wanted or usual
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OptionError(f"out: {str(folder)!r} cannot be written to: {error.strerror}") from error
    return folder


def write_page(
    page: ReportPage, metrics: object, figures: Iterable[NamedFigure], folder: Path, console: Console
) -> None:
    """Write ``report.html``, ``report.json`` and the figures into a folder; print the report and the paths.

    Args:
        page: everything but the figures.
        metrics: plain data.
        figures: each is drawn when the iterator is advanced.
        folder: exists.
        console: to print on.
    """
    saved = save_figures(figures, folder, _DPI)
    images = [(title, path.stem, base64.b64encode(path.read_bytes()).decode()) for title, path in saved]
    template = jinja2.Environment(autoescape=True).from_string(_TEMPLATE)
    html, data = folder / "report.html", folder / "report.json"
    print_page(page, console)  # first: the disk may be full
    write_whole(html, template.render(page=page, images=images))
    write_report(metrics, data)
    print_paths([html, data, *(path for _, path in saved)], console)


def print_page(page: ReportPage, console: Console) -> None:
    """Print a report without its long tables."""
    console.print(f"[bold]{escape(page.title)}[/bold]", highlight=False)
    console.print(escape(page.summary), highlight=False)
    for table in page.tables:
        if table.rows and not table.long:
            print_table(table, console)
    for note in page.notes:
        console.print(f"[yellow]Note:[/yellow] {escape(note)}", highlight=False, soft_wrap=True)
