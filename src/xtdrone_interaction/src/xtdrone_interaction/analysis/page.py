"""A report as one HTML page that needs no other file, and its pictures as PNG."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import jinja2

from xtdrone_interaction.analysis.drawing import Picture, plt
from xtdrone_interaction.plots import STYLE, file_name

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


@dataclass(frozen=True)
class Table:
    """A table of a report.

    Attributes:
        title: above it.
        head: of the columns, with units.
        rows: texts.
        long: whether it is folded on the page.
        texts: numbers of the columns, from 0, that are read and not compared.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    long: bool = False
    texts: frozenset[int] = frozenset()


@dataclass
class Page:
    """A report without its pictures.

    Attributes:
        title: of the page.
        summary: a sentence or two.
        notes: what puts it in doubt.
        tables: in order.
    """

    title: str
    summary: str
    notes: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)


def save_page(page: Page, pictures: Iterable[Picture], folder: Path) -> list[Path]:
    """Write the pictures and ``report.html`` into a folder, and return their paths, the page's first.

    Args:
        page: the words.
        pictures: drawn as they are asked for, so that all have one style.
        folder: where they go.
    """
    paths, images = [], []
    with plt.rc_context(STYLE):
        for picture in pictures:
            buffer = BytesIO()
            picture.figure.savefig(buffer, dpi=_DPI, format="png")
            plt.close(picture.figure)
            paths.append(folder / file_name(f"{picture.name}.png"))
            paths[-1].write_bytes(buffer.getvalue())
            images.append((picture.title, paths[-1].stem, base64.b64encode(buffer.getvalue()).decode()))
    template = jinja2.Environment(autoescape=True).from_string(_TEMPLATE)
    html = folder / "report.html"
    html.write_text(template.render(page=page, images=images), encoding="utf-8")
    return [html, *paths]
