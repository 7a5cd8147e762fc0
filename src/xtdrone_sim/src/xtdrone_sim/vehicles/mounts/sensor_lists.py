"""Lists of sensors in a vehicle's YAML, each entry read by its kind: ``lidars:``, ``imus:``, ``uwb:``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeVar

from xtdrone_control.settings import Settings
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import MountError


class _Mounted(Protocol):
    """Interface of the sensors in a list."""

    @property
    def name(self) -> str: ...

    @property
    def frame(self) -> str: ...


_Mount = TypeVar("_Mount", bound=_Mounted)
_Declared = TypeVar("_Declared", bound=Settings)


def read_list(entries: Any, kind: str, read: Callable[[Mapping[str, Any], str], _Mount]) -> tuple[_Mount, ...]:
    """Return the sensors of a list.

    Args:
        entries: content of the list; None for none.
        kind: name of the list.
        read: reads an entry; its second argument is the place for messages, such as ``imus, number 2``.

    Raises:
        MountError: not a list of mappings, an invalid entry, or a name or frame given twice.
    """
    if not isinstance(entries or [], list):
        raise MountError(f"{kind}: {entries!r} is not allowed, a list")
    mounts = tuple(_read(entry, f"{kind}, number {i}", read) for i, entry in enumerate(entries or [], start=1))
    for what, values in (("name", [m.name for m in mounts]), ("frame_id", [m.frame for m in mounts])):
        for value in values:
            if values.count(value) > 1:
                raise MountError(f"{kind}: {what} {value!r} is given {values.count(value)} times")
    return mounts


def reader(cls: type[_Declared]) -> Callable[[Mapping[str, Any], str], _Declared]:
    """Return a function that reads an entry of declared fields."""

    def read(entry: Mapping[str, Any], where: str) -> _Declared:
        try:
            return cls.from_mapping(entry, where)
        except ValueError as error:
            raise MountError(str(error)) from error

    return read


def _read(entry: Any, where: str, read: Callable[[Mapping[str, Any], str], _Mount]) -> _Mount:
    if not isinstance(entry, Mapping):
        raise MountError(f"{where}: {entry!r} is not allowed, a mapping")
    return read(entry, where)
