"""Things that documents name exist: files behind links and pictures, headings, launcher commands, launch files."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import REPOSITORY

DOCUMENTS = sorted(
    REPOSITORY / name
    for name in subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"],
        cwd=REPOSITORY,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
)
_LINK = re.compile(r"!?\[[^]]*\]\(([^)\s]+)\)")
_FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"\./xtdrone(?: +|\n *)([a-z][a-z0-9-]*)")
_LAUNCH_FILE = re.compile(r"(?<!/)\blaunch/[\w/]+\.(?:launch|yaml)\b")


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings on GitHub."""
    titles = re.findall(r"^#+ +(.+)$", _FENCED.sub("", text), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", title.lower()) for title in titles)
    return {title.replace(" ", "-") for title in plain}


def dead_links(document: Path) -> list[str]:
    """Return the links of a document without a target in the repository."""
    return [link for link in _LINK.findall(_FENCED.sub("", document.read_text())) if not _leads(document, link)]


def _leads(document: Path, link: str) -> bool:
    if re.match(r"[a-z]+:", link):
        return True
    name, _, anchor = link.partition("#")
    target = document.parent / name if name else document
    return target.exists() and (not anchor or anchor in anchors(target.read_text()))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_links_lead_somewhere(document: Path) -> None:
    assert dead_links(document) == []


def test_a_dead_link_is_found(tmp_path: Path) -> None:
    document = tmp_path / "a.md"
    document.write_text(
        "# One `two`, three\n[a](a.md) [b](#one-two-three) ![c](c.png)\n[d\ne](a.md#four) [f](https://x.org)\n"
        "```\n[g](g)\n```\n"
    )
    assert dead_links(document) == ["c.png", "a.md#four"]


def test_documents_name_existing_commands_and_launch_files() -> None:
    usage = subprocess.run([REPOSITORY / "xtdrone", "--help"], check=True, capture_output=True, text=True).stdout
    commands = set(re.findall(r"^  ([a-z][a-z0-9-]*)", usage, re.MULTILINE))
    wrong = [
        (document.name, name)
        for document in DOCUMENTS
        for name in set(_COMMAND.findall(document.read_text())) - commands
    ] + [
        (document.name, name)
        for document in DOCUMENTS
        for name in set(_LAUNCH_FILE.findall(document.read_text()))
        if not (REPOSITORY / name).is_file()
    ]
    assert wrong == []


def test_the_site_lists_every_page() -> None:
    def files(entry: Any) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        return [name for value in (entry.values() if isinstance(entry, dict) else entry) for name in files(value)]

    configuration = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text())
    pages = {str(page.relative_to(REPOSITORY / "docs")) for page in (REPOSITORY / "docs").rglob("*.md")}
    assert set(files(configuration["nav"])) == pages


def test_every_page_is_two_clicks_from_the_readme() -> None:
    def linked(page: Path) -> set[Path]:
        names = (link.partition("#")[0] for link in _LINK.findall(_FENCED.sub("", page.read_text())))
        return {(page.parent / name).resolve() for name in names if name.endswith(".md") and ":" not in name}

    first = linked(REPOSITORY / "README.md")
    second = {page for near in first for page in linked(near)}
    assert set((REPOSITORY / "docs").rglob("*.md")) <= first | second


def test_the_chinese_readme_has_the_commands_pictures_and_links_of_the_english_one() -> None:
    english, chinese = ((REPOSITORY / name).read_text() for name in ("README.md", "README.zh.md"))
    assert _FENCED.findall(chinese) == _FENCED.findall(english)
    inline = re.compile(r"`(\./xtdrone [^`]*)`")
    assert set(inline.findall(chinese)) == set(inline.findall(english))
    assert set(_LINK.findall(chinese)) - {"README.md"} == set(_LINK.findall(english)) - {"README.zh.md"}
