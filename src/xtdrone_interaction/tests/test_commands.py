"""The table of commands: each has a module, its own help, and an entry in the launcher and in the completion."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess

import pytest

from xtdrone_interaction import cli
from xtdrone_interaction.command_options import repository

COMMANDS = cli.read_commands()
OF_MODULES = [name for name, command in COMMANDS.items() if command.module]


@pytest.mark.parametrize("name", OF_MODULES)
def test_each_command_has_a_description_and_arguments(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([*name.split(), "--help"])
    assert ended.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith(f"usage: xtdrone {name} ")
    parser = COMMANDS[name].parser(COMMANDS[name].load())
    assert parser.description
    assert " ".join(parser.description.split())[:40] in said
    assert callable(COMMANDS[name].load().run)


@pytest.mark.parametrize("words", [[], ["fly"], ["demo"], ["demo", "fly"]])
def test_an_unknown_command_is_rejected_with_all_names(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 2
    assert not words or "demo formation" in capsys.readouterr().err


def test_the_launcher_lists_the_commands_of_the_table() -> None:
    usage = subprocess.run([repository() / "xtdrone", "--help"], check=True, capture_output=True, text=True).stdout
    listed = re.findall(r"^  (\S+) (.*)$", usage, re.MULTILINE)
    assert [name for name, _ in listed] == [name for name in COMMANDS if " " not in name]
    for name, text in listed:
        assert COMMANDS[name].help in text
        assert text.startswith(COMMANDS[name].synopsis)


def test_help_of_a_group_lists_its_members() -> None:
    for words in (["help", "demo"], ["demo", "--help"]):
        run = subprocess.run([repository() / "xtdrone", *words], check=True, capture_output=True, text=True)
        for name in ("hello", "formation", "simplified", "search", "slam"):
            assert re.search(rf"^  {name} +{re.escape(COMMANDS[f'demo {name}'].help)}$", run.stdout, re.MULTILINE)


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("xtdrone re", {"report", "record", "record-view", "replay-actions", "replay-check"}),
        ("xtdrone demo ", {"hello", "formation", "simplified", "search", "forest", "explore", "slam", "landing"}),
        ("xtdrone demo formation --contr", {"--control"}),
        ("xtdrone demo formation --control ", {"vel", "accel"}),
        ("xtdrone bench --o", {"--only"}),
        ("xtdrone soak --s", {"--short", "--seed", "--speed", "--script"}),
        ("xtdrone sim re", {"resume", "reset", "remove"}),
        ("xtdrone gcs params s", {"set", "save"}),
        ("xtdrone help comp", {"compare", "compare-px4", "completion"}),
        ("xtdrone bench --json runs/", set()),
    ],
)
def test_words_are_completed(line: str, offered: set[str], script: str) -> None:
    program = f"""{script}
        read -ra COMP_WORDS <<<"$1"
        [[ $1 != *" " ]] || COMP_WORDS+=("")
        COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
        _xtdrone
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    run = subprocess.run(["bash", "-euc", program, "_", line], capture_output=True, text=True, check=True)
    assert set(run.stdout.split()) == offered


@pytest.fixture(scope="module")
def script() -> str:
    """Return the completion script."""
    with contextlib.redirect_stdout(io.StringIO()) as written:
        assert cli.main(["completion", "bash"]) == 0
    return written.getvalue()
