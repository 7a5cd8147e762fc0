"""The check of commit messages accepts imperative subjects of at most 72 characters."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import pytest
from conftest import REPOSITORY


@pytest.fixture(scope="module")
def check() -> ModuleType:
    spec = importlib.util.spec_from_file_location("commit_subject", REPOSITORY / "scripts/check_commit_subject.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "subject", ["Add a counter", "Pass arguments on", "Focus the view", "Seed it", "Merge branch 'x'"]
)
def test_an_imperative_is_accepted(check: ModuleType, subject: str) -> None:
    assert check.find_faults(f"{subject}\n\nThe reason.\n") == []


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("", "empty"),
        ("Add " + "x" * 69, "73 characters"),
        ("Add it.", "full stop"),
        ("Added it", "'Added'"),
        ("Adds it", "'Adds'"),
        ("Adding it", "'Adding'"),
        ("Tests: words", "'Tests:'"),
        ("add it", "'add'"),
        ("Add it\nBecause.", "not empty"),
    ],
)
def test_faults_are_named(check: ModuleType, message: str, fault: str) -> None:
    assert fault in "\n".join(check.find_faults(message))
