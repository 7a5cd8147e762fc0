"""``./xtdrone completion bash``: a completion script, generated from the table of commands and their parsers."""

from __future__ import annotations

import argparse
import shlex

from xtdrone_interaction.cli import Command, parsers, read_commands

_SCRIPT = """\
# Completion of ./xtdrone for bash, made by './xtdrone completion bash'.
declare -A _xtdrone_words=(
{words}
)
declare -A _xtdrone_values=(
{values}
)

_xtdrone() {{
  local current="${{COMP_WORDS[COMP_CWORD]}}" previous="${{COMP_WORDS[COMP_CWORD - 1]}}" command="xtdrone" word
  for word in "${{COMP_WORDS[@]:1:COMP_CWORD-1}}"; do
    [[ ! -v _xtdrone_words["$command $word"] ]] || command="$command $word"
  done
  local offered="${{_xtdrone_values["$command $previous"]-${{_xtdrone_words[$command]}}}}"
  mapfile -t COMPREPLY < <(compgen -W "$offered" -- "$current")
}}
complete -o default -F _xtdrone xtdrone
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.description = (
        "Print a completion script. In your ~/.bashrc: source <(/path/to/xtdrone completion bash). The shell of "
        "'./xtdrone shell' has it already."
    )
    parser.add_argument("shell", choices=["bash"])


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    words: dict[str, list[str]] = {"xtdrone": []}
    values: dict[str, list[str]] = {}
    for name, command in read_commands().items():
        group, _, member = name.rpartition(" ")
        words[f"xtdrone {group}".rstrip()].append(member)
        words[f"xtdrone {name}"] = []
        if command.module:
            _add(command, words, values)
    words["xtdrone help"] = [word for word in words["xtdrone"] if word != "help"]
    print(_SCRIPT.format(words=_entries(words), values=_entries(values)), end="")
    return 0


def _add(command: Command, words: dict[str, list[str]], values: dict[str, list[str]]) -> None:
    """Add the options, sub-commands and choices of a command."""
    for path, parser in parsers(command):
        words[path] = []
        for action in parser._actions:
            words[path] += [option for option in action.option_strings if option.startswith("--")]
            choices = [str(choice) for choice in action.choices or ()]
            if not action.option_strings:
                words[path] += choices
            for option in action.option_strings if choices else ():
                values[f"{path} {option}"] = choices


def _entries(lists: dict[str, list[str]]) -> str:
    return "\n".join(f"  [{shlex.quote(key)}]={shlex.quote(' '.join(words))}" for key, words in lists.items())
