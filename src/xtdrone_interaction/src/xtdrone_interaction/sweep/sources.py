"""The user's own Python in a study: follower, leader, metric. Read once, sent by value, loaded in any process."""

from __future__ import annotations

import hashlib
import linecache
import sys
import types
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction.options import OptionError

MODULE = "xtdrone_study_"
"""Beginning of the names of the modules that users' files become."""


@dataclass(frozen=True)
class Source:
    """A file of the user's and the name in it that is meant.

    Attributes:
        path: of the file where the study was started.
        name: of the class or function.
        text: the file's content.
    """

    path: str
    name: str
    text: str

    @property
    def digest(self) -> str:
        """A short fingerprint of the file's content and the name."""
        return hashlib.sha256(f"{self.name}\n{self.text}".encode()).hexdigest()[:16]

    def plain(self) -> dict[str, str]:
        """Return the source as plain data."""
        return asdict(self)


def read_source(role: str, text: object, folder: Path) -> Source:
    """Return the source that ``FILE.py:NAME`` in a study means.

    Args:
        role: as ``follower``, for messages.
        text: what the study says.
        folder: that relative paths start from, the study's own.

    Raises:
        OptionError: it has another form, or the file cannot be read.
    """
    file, colon, name = text.rpartition(":") if isinstance(text, str) else ("", "", "")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise OptionError(f"{role}: {text!r} is not allowed; FILE.py:NAME")
    path = (folder / Path(file).expanduser()).resolve()
    try:
        return Source(str(path), name, path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OptionError(f"{role}: {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise OptionError(f"{role}: {path} is no text in UTF-8") from error


def load(role: str, source: Source) -> Any:
    """Return the object that a source means; its file is executed once a process.

    Raises:
        OptionError: the file cannot be executed, or it has no such name.
    """
    module_name = MODULE + source.digest
    module = sys.modules.get(module_name)
    if module is None:
        module = _execute(role, source, module_name)
    try:
        return getattr(module, source.name)
    except AttributeError:
        raise OptionError(f"{role}: {source.path} has no {source.name!r}") from None


def _execute(role: str, source: Source, module_name: str) -> types.ModuleType:
    module = types.ModuleType(module_name)
    module.__file__ = source.path
    sys.modules[module_name] = module  # data classes look themselves up there
    # Where the file is not, a traceback shows its lines all the same.
    linecache.cache[source.path] = (len(source.text), None, source.text.splitlines(keepends=True), source.path)
    folder = str(Path(source.path).parent)
    if folder not in sys.path:
        sys.path.append(folder)  # its neighbours, where there are any
    try:
        exec(compile(source.text, source.path, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:  # whatever the user's file raises
        del sys.modules[module_name]
        raise OptionError(f"{role}: {source.path} cannot be loaded: {type(error).__name__}: {error}") from error
    return module


def class_attributes(cls: type) -> dict[str, bool | int | float | str]:
    """Return what a user's class can be set to: its public attributes that are numbers, truth values or texts."""
    found: dict[str, bool | int | float | str] = {}
    for base in reversed(cls.__mro__[:-1]):
        if base.__module__.startswith(MODULE) or not base.__module__.startswith("xtdrone_"):
            public = {name: value for name, value in vars(base).items() if not name.startswith("_")}
            found |= {name: value for name, value in public.items() if isinstance(value, bool | int | float | str)}
    return found
