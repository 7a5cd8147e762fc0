"""Flight logs by the ground station, from real MAVLink servers while time is paused."""

from __future__ import annotations

import random

import pytest
from gcs_field import FIRST, Field, LossyLine
from gcs_script import beat, talk, told
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.logger.log_folder import LogFolder
from xtdrone_interaction.gcs import GcsError, Peer, station
from xtdrone_interaction.gcs.exchanges import logs
from xtdrone_interaction.gcs.exchanges.exchange import RefusalError
from xtdrone_interaction.gcs.exchanges.logs import Log
from xtdrone_interaction.gcs_commands import logs as log_commands
from xtdrone_interaction.gcs_commands.gcs_cli import main

PATIENCE = 120.0  # s; only a broken run takes so long
SIZES = {"2020-01-01/00_00_05.ulg": 90 * 300 + 17, "2020-01-01/00_10_00.ulg": 1000, "2020-01-02/00_00_00.ulg": 90}
FILES = ["log_0_2020-01-01_00-00-05.ulg", "log_1_2020-01-01_00-10-00.ulg", "log_2_2020-01-02_00-00-00.ulg"]


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Vehicles, the last of them without logs."""
    field = Field()
    noise = random.Random(1)
    folders = [LogFolder(tmp_path_factory.mktemp(f"logs{i}")) for i in range(3)]
    for folder in folders[:2]:
        for name, size in SIZES.items():
            path = folder.root / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(noise.randbytes(size))
    field.autopilot.logs = folders
    yield field
    field.close()


def content(field, index):
    return [(field.autopilot.logs[index].root / name).read_bytes() for name in SIZES]


def vehicles(field):
    return ["--vehicle", *[str(vehicle.id) for vehicle in field.vehicles]]


def test_logs_are_listed(field, capsys):
    assert main(["logs", "list", *vehicles(field)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 7
    assert [line for line in lines if line[1:] == ["no", "logs"]] == [[f"vehicle_{field.vehicles[2].id}", "no", "logs"]]
    assert lines[0] == [f"vehicle_{FIRST}", "0", "2020-01-01", "00:00:05", "27017", "bytes"]


def test_logs_are_downloaded(field, tmp_path, capsys):
    assert main(["logs", "download", "--to", str(tmp_path), *vehicles(field)]) == 0  # the newest
    assert f"vehicle_{FIRST + 2}  it has no logs" in capsys.readouterr().out
    assert main(["logs", "download", "all", "--to", str(tmp_path), *vehicles(field)]) == 0
    for index in range(2):
        folder = tmp_path / f"vehicle_{FIRST + index}"
        assert sorted(path.name for path in folder.iterdir()) == FILES
        assert [(folder / name).read_bytes() for name in FILES] == content(field, index)


def test_an_interrupted_study_is_continued(field, tmp_path):
    whole = content(field, 0)[0]
    folder = tmp_path / f"vehicle_{FIRST}"
    folder.mkdir()
    part = folder / f"{FILES[0]}.{len(whole)}.part"
    kept = b"kept" + whole[4:5000]
    part.write_bytes(kept)
    only = ["--to", str(tmp_path), "--vehicle", str(FIRST)]
    assert main(["logs", "download", "0", *only]) == 0
    assert (folder / FILES[0]).read_bytes() == kept + whole[5000:]
    assert not part.exists()


def test_over_a_line_that_loses_a_third(field, tmp_path):
    line = LossyLine(field.ports, 0.3, 6)
    try:
        peers = [Peer(name, 0, "127.0.0.1", port) for name, port in line.ports.items()][:2]

        def fetch(name):
            return lambda beat: log_commands.download(beat, ["all"], tmp_path / name, lambda *_: None)

        jobs = {peer: fetch(peer.name) for peer in peers}
        results = station.run(jobs, timeout=0.1, patience=PATIENCE, on_abort=logs.end_transfer)
        assert [result for result in results.values() if isinstance(result, GcsError)] == []
        for index, peer in enumerate(peers):
            assert [(tmp_path / peer.name / name).read_bytes() for name in FILES] == content(field, index)
    finally:
        line.close()


def test_logs_that_are_not_there(field, capsys):
    assert main(["logs", "download", "9", "--vehicle", str(FIRST)]) == 1
    assert "log 9: not allowed, one of the vehicle's: 0, 1, 2" in capsys.readouterr().err
    assert main(["logs", "download", "new", "--vehicle", str(FIRST)]) == 2
    assert "'new' is not allowed, numbers or all" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written(field, tmp_path, capsys):
    (tmp_path / f"vehicle_{FIRST}").write_text("in the way")
    assert main(["logs", "download", "--to", str(tmp_path), "--vehicle", str(FIRST)]) == 1
    assert "cannot be written: File exists" in capsys.readouterr().err


def test_a_log_shorter_than_announced():
    end = told(mavlink.MAVLink_log_data_message(1, 90, 0, [0] * 90))
    first = told(mavlink.MAVLink_log_data_message(1, 0, 90, [7] * 90))
    with pytest.raises(RefusalError, match="log 1: it ends before 180 bytes"):
        talk(logs.download(beat(), Log(1, 0, 180), lambda _: None), lambda _: [first, end])


def test_a_vehicle_that_sends_nothing_is_left():
    with pytest.raises(RefusalError, match="sends no more at 0 of 180 bytes"):
        talk(logs.download(beat(), Log(1, 0, 180), lambda _: None), lambda _: [])
    with pytest.raises(RefusalError, match="has listed 0"):
        talk(logs.fetch_list(beat()), lambda _: [])
