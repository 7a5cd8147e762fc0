"""Comparing flights by their digest files."""

from __future__ import annotations

import argparse
import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from validation.replay import replay_check as replay_check
from validation.replay.digest_comparison import DigestError, compare, read_digests
from xtdrone_interaction import cli
from xtdrone_interaction.command_options import OptionError

SECOND = 1_000_000
LATE = 100 * SECOND


def write(path: Path, *rows: tuple[int, str, dict[str, list[int]]]) -> Path:
    path.write_text("".join(json.dumps({"time": t, "name": n, "topics": topics}) + "\n" for t, n, topics in rows))
    return path


def flight(path: Path, last: list[int] | None = None) -> Path:
    return write(
        path,
        (0, "/a", {"/x": [1, 10, 111]}),
        (SECOND, "/a", {"/x": [31, 310, 222], "/y": [1, 4, 5]}),
        (SECOND, "/b", {"/z": [9, 9, 9]}),
        (2 * SECOND, "/a", {"/x": last or [61, 610, 333], "/y": [1, 4, 5]}),
    )


def test_equal_files_are_the_same_and_say_how_much_was_compared(tmp_path: Path) -> None:
    first, second = (read_digests(flight(tmp_path / name)) for name in ("a", "b"))
    result = compare(first, second, LATE)
    assert result.same
    assert (result.time, result.topics, result.messages, result.bytes) == (2.0, 3, 71, 623)


@pytest.mark.parametrize("last", [[62, 610, 333], [61, 611, 333], [61, 610, 334]])
def test_the_first_difference_is_named(tmp_path: Path, last: list[int]) -> None:
    first, second = read_digests(flight(tmp_path / "a")), read_digests(flight(tmp_path / "b", last))
    result = compare(first, second, LATE)
    assert (result.same, result.difference_time, result.differing) == (False, 2.0, ("/x",))
    assert "/x" in replay_check.verdict(result)
    assert compare(first, second, 2 * SECOND - 1).same, "what is later does not count"


def test_a_topic_that_only_one_flight_has_is_a_difference(tmp_path: Path) -> None:
    first = read_digests(flight(tmp_path / "a"))
    second = read_digests(write(tmp_path / "b", (0, "/a", {"/x": [1, 10, 111], "/more": [0, 0, 0]})))
    assert compare(first, second, LATE).differing == ("/more",)


def test_whose_process_publishes_does_not_matter_unless_several_do(tmp_path: Path) -> None:
    apart = write(tmp_path / "a", (0, "/f1", {"/x": [1, 1, 1]}), (0, "/f2", {"/y": [2, 2, 2]}))
    together = write(tmp_path / "b", (0, "/f", {"/x": [1, 1, 1], "/y": [2, 2, 2]}))
    assert compare(read_digests(apart), read_digests(together), LATE).same
    two = write(tmp_path / "c", (0, "/f1", {"/x": [1, 1, 1]}), (0, "/f2", {"/x": [2, 2, 2]}))
    swapped = write(tmp_path / "d", (0, "/f1", {"/x": [2, 2, 2]}), (0, "/f2", {"/x": [1, 1, 1]}))
    assert not compare(read_digests(two), read_digests(swapped), LATE).same


def test_the_truth_alone_can_be_compared(tmp_path: Path) -> None:
    whole = read_digests(
        write(tmp_path / "a", (0, "/s", {"truth": [1, 1, 1], "/x": [1, 1, 1]}), (5, "/f", {"/y": [2, 2, 2]}))
    )
    bare = read_digests(write(tmp_path / "b", (0, "/s", {"truth": [1, 1, 1]})))
    assert not compare(whole, bare, LATE).same
    result = compare(whole.truth(), bare, LATE)
    assert result.same
    assert result.topics == 1


def test_nothing_compared_is_not_the_same(tmp_path: Path) -> None:
    nothing = read_digests(write(tmp_path / "a"))
    assert not compare(nothing, nothing, LATE).same


def test_a_truncated_line_is_skipped(tmp_path: Path) -> None:
    path = flight(tmp_path / "a")
    path.write_text(path.read_text() + '{"time": 3000000, "na')
    assert read_digests(path).end == 2 * SECOND


@pytest.mark.parametrize("text", ["not json\n", '{"time": 1}\n', "[]\n"])
def test_other_files_are_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "x").write_text(text)
    with pytest.raises(DigestError, match="x"):
        read_digests(tmp_path / "x")
    with pytest.raises(DigestError, match="none"):
        read_digests(tmp_path / "none")


@pytest.mark.parametrize(
    ("options", "word"),
    [(["--until", "-1"], "until"), (["--n", "1"], "--n"), (["--seed", "x"], "seed"), (["--out", "a b"], "space")],
)
def test_invalid_values_are_reported(options: list[str], word: str, capsys: Any) -> None:
    try:
        status: Any = cli.main(["replay-check", *options])
    except SystemExit as ended:  # argparse
        status = ended.code
    assert status == 2
    assert word in capsys.readouterr().err


def test_two_digest_files_are_compared_by_the_command(tmp_path: Path, capsys: Any) -> None:
    first, same, other = flight(tmp_path / "a"), tmp_path / "b", flight(tmp_path / "c", [62, 610, 333])
    lines = first.read_text().splitlines(keepends=True)
    same.write_text("".join([lines[0], lines[2], lines[1], lines[3]]))  # nodes of one second in another order
    assert cli.main(["replay-check", "--compare", str(first), str(same)]) == 0
    assert "3 topics, 71 messages, until 2.000 s: the same to the last bit" in capsys.readouterr().out
    assert cli.main(["replay-check", "--compare", str(first), str(other)]) == 1
    assert "differs in the second before 2.000 s: /x" in capsys.readouterr().out
    assert cli.main(["replay-check", "--compare", str(first), str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err


def test_the_short_form_is_short() -> None:
    parser = argparse.ArgumentParser()
    replay_check.add_arguments(parser)
    try:
        settings = replay_check.replay_settings(parser.parse_args(["--short"]))
    except OptionError as error:
        pytest.skip(str(error))  # another simulation runs on this machine
    assert (settings.n, settings.patterns) == (3, ("origin",))
    assert 0.0 < settings.until <= 20.0


def test_a_used_folder_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr(replay_check.command_options, "check_vehicle_ports", lambda fleet: None)
    (tmp_path / "digest.jsonl").touch()
    assert cli.main(["replay-check", "--short", "--out", str(tmp_path)]) == 2
    assert "not an empty folder" in capsys.readouterr().err


def test_the_outcome_is_plain_data_and_its_table_fits_80_columns(tmp_path: Path) -> None:
    digests = read_digests(flight(tmp_path / "a"))
    other = read_digests(flight(tmp_path / "b", [62, 610, 333]))
    known = replay_check.Flight(replay_check.REFERENCE, digests, 9.0, 2 * SECOND)
    rows = [
        (replay_check.Flight(circumstance, found, 123.4, 2 * SECOND), compare(digests, found, LATE))
        for circumstance, found in zip(replay_check.SHORT, (digests, other, digests), strict=True)
    ]
    settings = replay_check.ReplaySettings(3, ("origin",), 12.0, 0, replay_check.SHORT, tmp_path)
    data = json.loads(json.dumps(replay_check.outcome_data(settings, known, rows)))
    assert (data["same"], [row["same"] for row in data["flights"]]) == (False, [True, False, True])
    assert data["flights"][1]["differing"] == ["/x"]
    console = Console(file=io.StringIO(), width=80)
    replay_check._print_table(known, rows, console)
    shown = console.file.getvalue()
    for word in ("a process per vehicle", "messages", "outcome", "differs", "same"):
        assert word in shown
    assert "…" not in shown
