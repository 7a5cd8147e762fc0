"""Shared by this package's tests: the made-up flight."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from synthetic import make_bag


@pytest.fixture(scope="session")
def flight_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good flight's bag."""
    path = tmp_path_factory.mktemp("flight") / "flight.bag"
    make_bag(path)
    return path
