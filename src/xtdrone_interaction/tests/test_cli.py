"""The command line: rejections and their messages, and no process left running."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import types
from pathlib import Path

import fake_roslaunch
import pytest

from xtdrone_interaction import cli, command_options
from xtdrone_interaction.launching import launch_cli
from xtdrone_interaction.missions.formation import cli as formation_cli
from xtdrone_interaction.missions.search import cli as search_cli

DEMO = ["demo", "formation"]
PATIENCE = 120.0  # s of wall time; bounds a broken test


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n", "0"], "--n: '0' is not allowed, a whole number from 2 to 250"),
        (["--n", "10000"], "--n: '10000' is not allowed, a whole number from 2 to 250"),
        (["--n", "nine"], "'nine' is not allowed"),
        (["--type", "zeppelin"], "vehicle type: 'zeppelin' is unknown; there are: "),
        (["--world", "moon"], "world: 'moon' is unknown; there are city, "),
        (["--patterns", "cube,heart"], "pattern 'heart' is unknown for 9 vehicles; there are: "),
        (["--patterns", "cube,,cube"], "--patterns: 'cube,,cube' is not allowed"),
        (["--n", "9", "--patterns", "T"], "pattern 'T' is unknown for 9 vehicles"),
        (
            ["--patterns", "sphere:spacing=far"],
            "pattern 'sphere:spacing=far': spacing: 'far' is not allowed, 0.5 to 1000",
        ),
        (["--patterns", "text"], "pattern 'text': text needs WORDS, as text:XTD"),
        (["--patterns", "cloud:/nowhere.ply"], "cloud /nowhere.ply: No such file"),
        (["--speed", "0"], "--speed: '0' is not allowed, a real-time factor of at least 0.01, or 'unlimited'"),
        (["--speed", "-2"], "--speed: '-2' is not allowed"),
        (["--speed", "nan"], "--speed: 'nan' is not allowed"),
        (["--seed", "-1"], "--seed: '-1' is not allowed"),
        (["--waive", "speed"], "--waive: 'speed' is not allowed, comma-separated names, of settling, steady-error"),
        (["--clearance", "inf"], "--clearance: 'inf' is not allowed"),
        (["--processes", "many"], "invalid choice: 'many' (choose from 'per-uav', 'merged', 'shared')"),
        (["--master-port", "80"], "--master-port: '80' is not allowed, a whole number from 1024 to 65535"),
        (["--follower", "mine.py"], "follower: mine.py does not exist"),
        (["--pattern-file", "/nowhere.yaml"], "pattern file /nowhere.yaml"),
    ],
)
def test_invalid_values_are_reported(arguments: list[str], message: str, capfd: pytest.CaptureFixture[str]) -> None:
    try:
        status = cli.main([*DEMO, *arguments])
    except SystemExit as error:  # argparse
        status = error.code
    assert status == 2
    assert message in capfd.readouterr().err


def test_a_pattern_of_the_wrong_size_is_rejected(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("9: {row: [[1, 0, 0], [2, 0, 0]]}")
    assert cli.main([*DEMO, "--pattern-file", str(file), "--patterns", "row"]) == 2
    assert "size 2 x 3, but 9 vehicles need 8 x 3" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("option", "code", "words"),
    [
        ("--follower", "", "must define one class that inherits Follower"),
        ("--follower", "class X(:", "cannot be imported: SyntaxError"),
        ("--leader", "import no_such_module", "cannot be imported: ModuleNotFoundError"),
        ("--leader", "from xtdrone_coordination.follower import Follower\nclass A(Follower): ...", "inherits Leader"),
    ],
)
def test_a_class_that_cannot_fly_is_rejected_before_anything_starts(
    tmp_path: Path, option: str, code: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "unflyable_class.py").write_text(code)
    out = tmp_path / "out"
    assert cli.main([*DEMO, option, str(tmp_path / "unflyable_class.py"), "--out", str(out)]) == 2
    assert words in capfd.readouterr().err
    assert not out.exists()


def test_a_master_port_in_use_is_rejected(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    # Another simulation may be running.
    monkeypatch.setattr(command_options, "check_vehicle_ports", lambda fleet, **_: None)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert cli.main([*DEMO, "--master-port", str(port)]) == 2
    assert f"port: {port} is taken" in capfd.readouterr().err


def test_a_mavlink_port_in_use_is_rejected(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(command_options, "_taken", lambda number, kind: number == 24542)
    assert cli.main([*DEMO, "--instance", "0"]) == 2
    assert "port: UDP 24542 of iris_2 is taken" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("argument", "port", "words"),
    [
        ("mavros:=false", 24541, ""),  # real MAVROS listens already
        ("mavros:=elsewhere", 24541, ""),
        ("fcu_url:=udp://:25540@127.0.0.1:34580", 24541, ""),  # our layer has another port
        ("mavros:=true", 24541, "UDP 24541 of iris_1 is taken by another program (beside real MAVROS: mavros:=false)"),
        ("ports:=px4", 14541, "UDP 14541 of iris_1 is taken"),
        ("ports:=px4", 24541, ""),
        ("mavros_nodes:=per_uav", 24541, "UDP 24541 of iris_1 is taken"),
        ("mavros:=false", 34581, "UDP 34581 of iris_1 is taken by another program;"),  # the simulator's own
    ],
)
def test_a_launch_is_refused_for_ports_that_it_binds_itself(
    argument: str, port: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd
) -> None:
    monkeypatch.setattr(command_options, "_taken", lambda number, kind: number == port)
    monkeypatch.setattr(command_options, "_take", lambda name: True)
    launched: list[str] = []
    monkeypatch.setattr(launch_cli, "_run", lambda file, launch, console: launched.append(launch.file) or 0)
    command = [
        "launch",
        "multi_vehicle",
        "vehicles:=iris:2",
        argument,
        "--out",
        str(tmp_path / "out"),
        "--port",
        "22000",
    ]
    assert cli.main(command) == (2 if words else 0)
    assert words in capfd.readouterr().err
    assert len(launched) == (not words)


@pytest.mark.parametrize(
    "name",
    ["ROS_NAMESPACE", "ROSCONSOLE_FORMAT", "ROSCONSOLE_CONFIG_FILE", "ROS_PYTHON_LOG_CONFIG_FILE", "MPLBACKEND"],
)
def test_variables_under_which_a_launch_fails_are_left_out_with_a_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command_options, "_taken", lambda number, kind: False)
    monkeypatch.setattr(command_options, "_take", lambda name: True)
    environments: list[dict[str, str]] = []
    monkeypatch.setattr(launch_cli, "_run", lambda file, launch, _: environments.append(launch.environment()) or 0)
    command = ["launch", "multi_vehicle", "--out", str(tmp_path / "out"), "--port", "22000"]
    monkeypatch.setenv("ROS_HOSTNAME", "here")
    for value in ("uav0", ""):
        monkeypatch.setenv(name, value)
        assert cli.main(command) == 0
    lines = [line for line in capfd.readouterr().err.splitlines() if "environment" in line]
    assert len(lines) == 1
    assert lines[0].startswith(f"xtdrone: {name}=uav0 is left out of the environment: ")
    assert not any(name in environment for environment in environments)
    assert [environment["ROS_HOSTNAME"] for environment in environments] == ["here"] * 2  # honoured


@pytest.mark.parametrize("demo", ["formation", "search"])
def test_a_demo_uses_the_first_instance_with_free_ports(
    demo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        command_options, "_taken", lambda number, kind: number in (24542, 19110)
    )  # of instances 0 and 1
    flown: list[int] = []
    monkeypatch.setattr(formation_cli, "fly", lambda settings, console: flown.append(settings.instance) or 0)
    monkeypatch.setattr(search_cli, "fly", lambda settings, console: flown.append(settings.instance) or 0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind("\0xtdrone-instance-2")  # another command is about to start
        assert cli.main(["demo", demo, "--out", str(tmp_path / "out")]) == 0
    assert flown == [3]


def test_a_missing_master_is_reported(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    uri = f"http://127.0.0.1:{command_options.free_port()}"
    monkeypatch.setenv("ROS_MASTER_URI", uri)
    monkeypatch.setattr(command_options, "_taken", lambda number, kind: False)
    assert cli.main([*DEMO, "--use-master"]) == 2
    assert uri in capfd.readouterr().err


def test_a_used_folder_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command_options, "_taken", lambda number, kind: False)
    (tmp_path / "report.json").touch()
    assert cli.main([*DEMO, "--out", str(tmp_path)]) == 2
    assert "not an empty folder" in capfd.readouterr().err


def test_a_nearly_full_disk_is_rejected_before_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda place: types.SimpleNamespace(free=3 << 20))
    assert cli.main([*DEMO, "--out", str(tmp_path / "new" / "flight")]) == 2
    assert "is on a disk with 3 MB left; a flight is recorded with at least 1024 MB" in capfd.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_closed_output_pipe_does_not_end_a_flight(tmp_path: Path) -> None:
    options = ["--n", "4", "--patterns", "triangle", "--film", "none", "--no-compare", "--headless"]
    command = [sys.executable, "-m", "xtdrone_interaction", "demo", "simplified", "--without-ros", *options]
    with subprocess.Popen([*command, "--out", str(tmp_path / "out")], stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        assert demo.stdout.readline().startswith("Results:")
        demo.stdout.close()
        assert demo.wait(PATIENCE) == 0
    assert (tmp_path / "out" / "report.json").is_file()


def test_report_is_made_again(flight_bag: Path) -> None:
    assert cli.main(["report", str(flight_bag)]) == 0
    assert json.loads((flight_bag.parent / "report.json").read_text())["outcome"] == "done"
    assert (flight_bag.parent / "formations.png").is_file()


def test_report_names_a_missing_bag(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", "/nowhere.bag"]) == 1
    assert "/nowhere.bag does not exist" in capfd.readouterr().err


FAKE_ROSLAUNCH = """\
#!{python}
# Starts 'nodes' as roslaunch does, each in a session of its own: one good, one that ignores SIGINT and SIGTERM.
import os, signal, socket, subprocess, sys, time
good = "import time; time.sleep(600)"
stubborn = "import signal, time; [signal.signal(s, signal.SIG_IGN) for s in (2, 15)]; time.sleep(600)"
for code in (good, stubborn):
    subprocess.Popen([sys.executable, "-c", "MARK = {mark!r}; " + code], start_new_session=True)
socket.create_connection(("127.0.0.1", {port})).close()
{then}
"""


@pytest.mark.parametrize(
    ("then", "number", "status"),
    [
        ("time.sleep(600)", signal.SIGINT, 130),
        ("time.sleep(600)", signal.SIGTERM, 143),
        ("os.kill(os.getpid(), signal.SIGKILL)", None, 1),
    ],
)
def test_nothing_is_left_running(tmp_path: Path, then: str, number: int | None, status: int) -> None:
    """All nodes end after Ctrl-C, SIGTERM, and the death of roslaunch, even one that ignores signals."""
    mark = f"xtdrone-test-{os.getpid()}-{tmp_path.name}"
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(PATIENCE)
    path = fake_roslaunch.install(
        tmp_path, FAKE_ROSLAUNCH.format(python=sys.executable, mark=mark, port=server.getsockname()[1], then=then)
    )
    program = textwrap.dedent(f"""
        import sys
        from xtdrone_interaction import cli, command_options
        from xtdrone_interaction.missions.search import cli as search_cli
        from xtdrone_interaction.launching import process_tree
        process_tree._STEPS = tuple((s, 0.5) for s, _ in process_tree._STEPS)
        command_options._taken = lambda number, kind: False
        sys.exit(cli.main(["demo", "formation", "--headless", "--out", {str(tmp_path / "out")!r}]))
    """)
    demo = subprocess.Popen(
        [sys.executable, "-c", program], env={**os.environ, "PATH": path}, stdout=subprocess.PIPE, text=True
    )
    with server:
        server.accept()[0].close()  # the fake roslaunch has started its nodes
    if number is not None:
        assert fake_roslaunch.running(mark)
        demo.send_signal(number)
    output, _ = demo.communicate(timeout=PATIENCE)
    assert demo.returncode == status, output
    assert fake_roslaunch.running(mark) == []


def test_help_shows_each_default_once_as_typed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*DEMO, "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "(default: cube,pyramid,triangle)" in said
    assert "(default: unlimited)" in said
    assert not any(word in said for word in ("None", "False", "0.0)", "['"))
