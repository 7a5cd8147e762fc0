"""Fixtures of this package's tests: the synthetic flight."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from xtdrone_interaction import command_options

sys.path.insert(0, str(Path(__file__).parent))

from synthetic import make_bag


@pytest.fixture(autouse=True)
def kept_names(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Release the instances and folders that a test's commands have reserved for this process."""
    kept: dict[str, socket.socket] = {}
    monkeypatch.setattr(command_options, "_kept", kept)
    yield
    for keeper in kept.values():
        keeper.close()


@pytest.fixture(scope="session")
def flight_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good flight's bag."""
    path = tmp_path_factory.mktemp("flight") / "flight.bag"
    make_bag(path)
    return path
