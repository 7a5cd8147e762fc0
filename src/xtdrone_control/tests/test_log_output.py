"""A node's log on a full disk."""

from __future__ import annotations

import subprocess
import sys

_NODE = """
import logging
from rosgraph.roslogging import RosStreamHandler
from xtdrone_common.programs.plain_node import survive_full_disk

log = logging.getLogger("rosout")
log.addHandler(RosStreamHandler())
log.setLevel(logging.INFO)
if {survive}:
    survive_full_disk()
for _ in range(2):
    log.info("a word")
    log.error("a word")
"""


def status(survive: bool) -> int:
    """Return the exit status of a process that logs while its outputs are on a full disk."""
    with open("/dev/full", "w", encoding="utf-8") as full:
        program = [sys.executable, "-u", "-c", _NODE.format(survive=survive)]
        return subprocess.run(program, stdout=full, stderr=full, timeout=60.0, check=False).returncode


def test_a_node_continues_when_its_log_cannot_be_written():
    assert status(survive=False) != 0, "rospy's handler raises"
    assert status(survive=True) == 0
