"""The command line of XTDrone: ``python -m xtdrone_interaction NAME ...``, started by ``./xtdrone NAME ...``.

``scripts/commands.txt`` lists the commands. The module of a command defines

- ``add_arguments(parser)``: adds its description and its arguments;
- ``run(arguments) -> int``: runs it and returns its exit status;
- optionally ``parse(parser, words) -> Namespace``, where argparse's ``parse_args`` is not sufficient.

Only the module of the executed command is imported, so that commands start fast.

Exit status: that of the command, 2 for an invalid value, 128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from xtdrone_interaction.monitoring.launch_log_errors import advice

TABLE = Path(__file__).resolve().parents[4] / "scripts" / "commands.txt"
_NO_MODULE = "-"
_READS_LOGS = "the nodes' logs are read, and need their usual form"
_LEFT_OUT = {
    "ROS_NAMESPACE": "nodes and topics have fixed names, and would not find each other",
    "ROSCONSOLE_FORMAT": _READS_LOGS,
    "ROSCONSOLE_CONFIG_FILE": _READS_LOGS,
    "ROS_PYTHON_LOG_CONFIG_FILE": _READS_LOGS,
    "MPLBACKEND": "pictures are drawn into files",
}  # variables of a user's shell under which commands and launches fail, with the reasons


@dataclass(frozen=True)
class Command:
    """One line of the table.

    Attributes:
        name: one word, or two for a member of a group, as ``demo formation``.
        module: full name; empty for commands of the launcher itself and for groups.
        synopsis: of the arguments.
        help: one line.
    """

    name: str
    module: str
    synopsis: str
    help: str

    def load(self) -> ModuleType:
        """Import the module."""
        return importlib.import_module(self.module)

    def parser(self, module: ModuleType) -> argparse.ArgumentParser:
        """Return the parser of the command."""
        parser = argparse.ArgumentParser(prog=f"xtdrone {self.name}")
        module.add_arguments(parser)
        return parser


def read_commands() -> dict[str, Command]:
    """Return the table by name, in its order."""
    commands = {}
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            name, module, _, synopsis, text = (cell.strip() for cell in line.split("|"))
            commands[name] = Command(name, "" if module == _NO_MODULE else module, synopsis, text)
    return commands


def parsers(command: Command) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the parser of a command and those of its sub-commands, each with the words that select it."""
    yield from _with_inner(f"xtdrone {command.name}", command.parser(command.load()))


def _with_inner(path: str, parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    yield path, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield from _with_inner(f"{path} {name}", inner)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, by default from the program's arguments, and return its exit status."""
    _leave_out_variables()
    words = list(sys.argv[1:] if argv is None else argv)
    command, rest = _split(words)
    module = command.load()
    parser = command.parser(module)
    parse = getattr(module, "parse", argparse.ArgumentParser.parse_args)
    return int(module.run(parse(parser, rest)))


def _leave_out_variables() -> None:
    """Remove the variables of ``_LEFT_OUT`` from the environment, with a line for each."""
    for name, reason in _LEFT_OUT.items():
        value = os.environ.pop(name, "")
        if value:
            print(f"xtdrone: {name}={value} is left out of the environment: {reason}", file=sys.stderr)


def _split(words: Sequence[str]) -> tuple[Command, list[str]]:
    """Return the command that words begin with, and the words after its name; end with status 2 without one."""
    commands = {name: command for name, command in read_commands().items() if command.module}
    for length in (2, 1):
        name = " ".join(words[:length])
        if name in commands:
            return commands[name], list(words[length:])
    names = ", ".join(commands)
    parser = argparse.ArgumentParser(prog="xtdrone", usage="xtdrone NAME ...", epilog=f"Names: {names}.")
    if {"-h", "--help"}.intersection(words):
        parser.parse_args(["--help"])
    parser.error(f"unknown command {' '.join(words[:2])!r}; there are: {names}")


def start() -> None:
    """Run the command of the program's arguments and exit; the entry point of ``python -m``.

    Ctrl-C ends the program without a traceback at any time, and a lack of resources (memory, threads) is reported on
    one line, even if a library cannot be loaded because of it.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # nothing to clean up while modules are loaded
    _leave_out_variables()  # before libraries read them
    try:
        command, rest = _split(sys.argv[1:])
        command.load()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.exit(main([*command.name.split(), *rest]))
    except KeyboardInterrupt:  # outside a command's signal handling
        print("xtdrone: stopped by SIGINT", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    except Exception as error:
        causes: list[BaseException] = [error]
        while before := causes[-1].__cause__ or causes[-1].__context__:
            causes.append(before)
        reasons = advice(" ".join(map(repr, causes)))
        if not reasons:
            raise
        print(f"xtdrone: {type(error).__name__}: {reasons[0]}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    sys.exit(main())
