"""Parameters that no client of a server reads or changes: those with a name that ends in ``token``, at any depth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_ENDING = "token"


def is_secret(name: str) -> bool:
    """Return whether a parameter, or a namespace above it, has a name that ends in ``token``, in any case."""
    return any(part.lower().endswith(_ENDING) for part in name.split("/"))


def without_secrets(value: Any) -> Any:
    """Return a value of the parameter server without the secret entries of its mappings, also in lists."""
    if isinstance(value, Mapping):
        return {name: without_secrets(part) for name, part in value.items() if not is_secret(str(name))}
    if isinstance(value, (list, tuple)):
        return [without_secrets(part) for part in value]
    return value
