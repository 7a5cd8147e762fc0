"""A user's Python in a study: follower, leader, metric. Read once, sent as text, loaded in any process."""

from __future__ import annotations

import hashlib
import linecache
import sys
import types
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction.studies.study_parameters import StudyError

MODULE = "xtdrone_study_"
"""Prefix of the modules created from users' files."""


@dataclass(frozen=True)
class Source:
    """A class or function in a user's file.

    Attributes:
        path: of the file on the machine of the command.
        name: of the class or function.
        text: content of the file.
    """

    path: str
    name: str
    text: str

    @property
    def digest(self) -> str:
        """Short fingerprint of content and name."""
        return hashlib.sha256(f"{self.name}\n{self.text}".encode()).hexdigest()[:16]

    def plain(self) -> dict[str, str]:
        """Return the source as JSON data."""
        return asdict(self)


def read_source(role: str, text: object, folder: Path) -> Source:
    """Read the source ``FILE.py:NAME`` of a study.

    Args:
        role: such as ``follower``, for messages.
        text: in the study.
        folder: of the study, the base of relative paths.

    Raises:
        StudyError: invalid form, or the file cannot be read.
    """
    file, colon, name = text.rpartition(":") if isinstance(text, str) else ("", "", "")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise StudyError(f"{role}: {text!r} is not allowed; FILE.py:NAME")
    path = (folder / Path(file).expanduser()).resolve()
    try:
        return Source(str(path), name, path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StudyError(f"{role}: {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise StudyError(f"{role}: {path} is not a text in UTF-8") from error


def load(role: str, source: Source) -> Any:
    """Return the object of a source, executing its file once per process.

    Raises:
        StudyError: the file cannot be executed, or does not define the name.
    """
    module_name = MODULE + source.digest
    module = sys.modules.get(module_name)
    if module is None:
        module = _execute(role, source, module_name)
    try:
        return getattr(module, source.name)
    except AttributeError:
        raise StudyError(f"{role}: {source.path} has no {source.name!r}") from None


def _execute(role: str, source: Source, module_name: str) -> types.ModuleType:
    module = types.ModuleType(module_name)
    module.__file__ = source.path
    sys.modules[module_name] = module  # data classes look up their module there
    # Show the lines in tracebacks also on machines without the file.
    linecache.cache[source.path] = (len(source.text), None, source.text.splitlines(keepends=True), source.path)
    folder = str(Path(source.path).parent)
    if folder not in sys.path:
        sys.path.append(folder)  # for imports of neighbouring files
    try:
        exec(compile(source.text, source.path, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:  # the user's file may raise anything
        del sys.modules[module_name]
        raise StudyError(f"{role}: {source.path} cannot be loaded: {type(error).__name__}: {error}") from error
    return module


def class_attributes(cls: type) -> dict[str, bool | int | float | str]:
    """Return the public attributes of a user's class that are numbers, booleans or texts."""
    found: dict[str, bool | int | float | str] = {}
    for base in reversed(cls.__mro__[:-1]):
        if base.__module__.startswith(MODULE) or not base.__module__.startswith("xtdrone_"):
            public = {name: value for name, value in vars(base).items() if not name.startswith("_")}
            found |= {name: value for name, value in public.items() if isinstance(value, bool | int | float | str)}
    return found
