#!/usr/bin/env python3
"""Check the subject of a commit message, as git's commit-msg hook: ``python scripts/check_commit_subject.py FILE``.

An imperative cannot be told for sure without a dictionary; the endings rejected here are those of common slips.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

LONGEST = 72
"""Characters of a subject."""
_NOT_IMPERATIVE = re.compile(r"(?:\w+ing|\w+ed|\w+[^su]s)$", re.IGNORECASE)
_IMPERATIVES = frozenset(
    {"bring", "embed", "feed", "need", "seed", "shed", "speed", "string", "bias", "canvas", "alias"}
)
_GIT_OWN = ("Merge ", "Revert ", "fixup! ", "squash! ", "amend! ")


def find_faults(message: str) -> list[str]:
    """Return the faults of a commit message, one sentence each."""
    lines = [line for line in message.splitlines() if not line.startswith("#")]
    subject = lines[0].strip() if lines else ""
    if subject.startswith(_GIT_OWN):
        return []
    if not subject:
        return ["the subject is empty"]
    faults = []
    if len(subject) > LONGEST:
        faults.append(f"the subject has {len(subject)} characters, at most {LONGEST} are allowed")
    if subject.endswith("."):
        faults.append("the subject ends with a full stop")
    word = subject.split()[0]
    if word.lower() not in _IMPERATIVES and (not word[0].isupper() or _NOT_IMPERATIVE.match(word) or word[-1] == ":"):
        faults.append(f"the subject begins with {word!r}, a capitalised imperative is needed: Add, Join, Measure")
    if len(lines) > 1 and lines[1].strip():
        faults.append("the line after the subject is not empty")
    return faults


def main() -> int:
    """Print the faults of the message in a file; return 1 for any."""
    faults = find_faults(Path(sys.argv[1]).read_text(encoding="utf-8"))
    for fault in faults:
        print(f"commit message: {fault}", file=sys.stderr)
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
