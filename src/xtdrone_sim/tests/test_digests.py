"""The digest file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from xtdrone_lockstep.protocol import Digest
from xtdrone_sim.runtime.digest_file import TRUTH, DigestFile


def truth(value: float = 0.0) -> bytes:
    return np.full(3, value).tobytes()


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_line_a_second_and_one_at_the_end(tmp_path: Path) -> None:
    own = {"/gazebo/model_states": Digest()}
    file = DigestFile(tmp_path / "d", "/simulator", own)
    for tick in range(1, 111):
        own["/gazebo/model_states"].add(tick * 20_000, b"x")
        file.tick(tick * 20_000, truth())
    file.write("/leader", 2_000_000, {"/xtdrone/leader/pose": [1, 2, 3]})
    assert [line["time"] for line in lines(tmp_path / "d")] == [20_000, 1_000_000, 2_000_000, 2_000_000]
    file.close(2_200_000)
    last = lines(tmp_path / "d")[-1]
    assert (last["name"], last["time"]) == ("/simulator", 2_200_000)
    assert last["topics"][TRUTH][0] == last["topics"]["/gazebo/model_states"][0] == 110


def test_the_last_bit_of_the_truth_counts(tmp_path: Path) -> None:
    states = []
    for value in (1.0, np.nextafter(1.0, 2.0)):
        file = DigestFile(tmp_path / "d", "/simulator", {})
        file.tick(20_000, truth(value))
        states.append(lines(tmp_path / "d")[0]["topics"][TRUTH])
        file.close(20_000)
    assert states[0][:2] == states[1][:2]
    assert states[0][2] != states[1][2]


def test_a_full_disk_ends_the_file_and_not_the_flight() -> None:
    words: list[str] = []
    file = DigestFile(Path("/dev/full"), "/simulator", {}, words.append)
    file.tick(20_000, truth())
    file.tick(1_000_000, truth())
    file.close(1_000_000)
    assert len(words) == 1
    assert "/dev/full" in words[0]
    assert "No space left" in words[0]
