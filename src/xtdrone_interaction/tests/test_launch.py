"""``./xtdrone launch``, and demos that cannot start: a message, the exit status, and no process left running."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import fake_roslaunch
import pytest

from xtdrone_interaction import command_options
from xtdrone_interaction.launching import supervised_launch
from xtdrone_interaction.launching.supervised_launch import master_port
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes

pytestmark = pytest.mark.skipif(shutil.which("roslaunch") is None, reason="ROS is not there")
LIMIT = 120.0  # s of wall time; only a broken run takes it
_MODULES = {
    "launch": ["xtdrone_interaction", "launch"],
    "demo": ["xtdrone_interaction", "demo"],
}  # as ./xtdrone sets it
LAUNCH = """\
<launch>
  <arg name="code" default="0"/>
  <node pkg="rosbag" type="record" name="worker" launch-prefix="{folder}/worker"/>
  <node pkg="rosbag" type="record" name="boss" launch-prefix="{folder}/boss $(arg code)" required="true"/>
</launch>
"""
PROGRAMS = {  # the boss ends when the file "end" exists, the worker never
    "worker": "exec sleep 600",
    "boss": "while [ ! -e {folder}/end ]; do sleep 0.1; done; exit $1",
}


class Command:
    """A running command in a session of its own, and its output."""

    def __init__(self, folder: Path, *arguments: str, limits: Callable[[], None] | None = None) -> None:
        self.mark = f"XTDRONE_TEST_LAUNCH={folder}"
        self.file = folder / "output.txt"
        environment = {k: v for k, v in os.environ.items() if k not in ("ROS_MASTER_URI", "ROS_HOSTNAME", "DISPLAY")}
        with self.file.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", *_MODULES[arguments[0]], *arguments[1:], "--out", str(folder / "out")],
                env={**environment, "XTDRONE_TEST_LAUNCH": str(folder)},
                stdout=output,
                stderr=subprocess.STDOUT,
                preexec_fn=limits,
            )

    @property
    def output(self) -> str:
        return self.file.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, words: str) -> None:
        """Wait until the words are in the output."""
        end = time.monotonic() + LIMIT
        while words not in self.output:
            assert self.process.poll() is None, self.output
            assert time.monotonic() < end, self.output
            time.sleep(0.05)

    def end(self) -> int:
        """Wait for its end and return the status."""
        try:
            return self.process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            self.process.kill()
            pytest.fail(f"it does not end: {self.output}")

    def running(self) -> dict[int, str]:
        """Return id and command line of every live process that it has started."""
        found = {}
        for entry in Path("/proc").iterdir():
            try:
                if entry.name.isdigit() and self.mark.encode() in (entry / "environ").read_bytes():
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
        return found

    def gone(self) -> bool:
        """Wait until none of its processes runs; return whether that happens in time."""
        end = time.monotonic() + LIMIT
        while (left := self.running()) and time.monotonic() < end:
            time.sleep(0.1)
        return not left


@pytest.fixture
def launch_file(tmp_path: Path) -> Path:
    for name, program in PROGRAMS.items():
        path = tmp_path / name
        path.write_text("#!/bin/sh\n" + program.format(folder=tmp_path) + "\n")
        path.chmod(0o755)
    path = tmp_path / "tiny.launch"
    path.write_text(LAUNCH.format(folder=tmp_path))
    return path


@pytest.mark.parametrize(
    ("code", "kill", "status", "words"),
    [
        ("0", "", 0, ""),
        ("3", "", 1, "boss has died (exit code 3)"),
        ("0", "sleep 600", 1, "worker has died (SIGKILL)"),
    ],
)
def test_the_exit_status_shows_whether_all_nodes_ended_normally(
    launch_file: Path, code: str, kill: str, status: int, words: str
) -> None:
    command = Command(launch_file.parent, "launch", str(launch_file), f"code:={code}")
    command.wait_for("ready: 2 nodes; ROS master http://127.0.0.1:")
    if kill:
        os.kill(next(pid for pid, line in command.running().items() if line.strip() == kill), signal.SIGKILL)
        command.wait_for(words)
    (launch_file.parent / "end").touch()
    assert command.end() == status, command.output
    assert words in command.output
    assert ("has died" in command.output) == bool(status)
    assert command.running() == {}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGKILL])  # SIGTERM: test_cli.py
def test_a_signal_ends_all_of_it(launch_file: Path, number: int) -> None:
    command = Command(launch_file.parent, "launch", str(launch_file))
    command.wait_for("ready")
    command.process.send_signal(number)
    assert command.end() == (-number if number == signal.SIGKILL else 128 + number)
    if number == signal.SIGKILL:
        assert command.gone()
    assert command.running() == {}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["multi_vehicle", "vehicle:=iris:2"], "has no 'vehicle' (did you mean vehicles?); there are: autopilot, "),
        (["multi_vehicle", "rows"], "'rows' is not allowed, name:=value"),
        (["nowhere"], "'nowhere' does not exist; a path, or one of bench, "),
        (["formation", "control:=foo"], "control_is_vel_or_accel"),
        (["simplified", "--instance", "1"], "simplified.launch has no 'instance'"),
        (["multi_vehicle", "ports:=foo"], "ports: 'foo' is not allowed, xtdrone or px4"),
        (["formation", "n:=11", "ports:=px4"], "vehicles: 11 with ports 'px4' are not allowed, 1 to 10"),
        (["multi_vehicle", "--instance", "8"], "'8' is not allowed, a whole number from 0 to 7"),
        (["multi_vehicle", "--instance", "1", "instance:=2"], "--instance 1 and instance:=2 contradict"),
    ],
)
def test_invalid_launch_files_are_rejected_before_the_start(
    tmp_path: Path, arguments: list[str], words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    from xtdrone_interaction import cli

    try:
        status = cli.main(["launch", *arguments, "--out", str(tmp_path / "out")])
    except SystemExit as error:  # argparse
        status = int(error.code or 0)
    assert status == 2
    assert words in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["launch", "demo formation"])
def test_a_library_that_does_not_fit_into_memory_is_reported_in_one_line(tmp_path: Path, command: str) -> None:
    (tmp_path / "numpy.py").write_text("raise ImportError('lib.so: failed to map segment from shared object')")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    run = subprocess.run(
        [sys.executable, "-m", "xtdrone_interaction", *command.split()],
        env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 1
    assert run.stderr.startswith("xtdrone: ImportError: memory is short: ")
    assert run.stderr.count("\n") == 1


def test_a_missing_program_is_reported_before_the_start(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from xtdrone_interaction import cli

    for package, words in (("rosbag", "package 'rosbag' has no program 'no_such'"), ("no_pkg", "no package 'no_pkg'")):
        file = tmp_path / "bad.launch"
        file.write_text(f'<launch><node pkg="{package}" type="no_such" name="a"/></launch>')
        assert cli.main(["launch", str(file), "--out", str(tmp_path / "out")]) == 2
        assert words in capfd.readouterr().err


def _sockets(pids: dict[int, str]) -> list[tuple[str, str, str]]:
    """Return (kind, address, command line) of each TCP socket that listens and UDP socket that is bound."""
    owners = {}
    for pid, line in pids.items():
        for link in Path(f"/proc/{pid}/fd").iterdir():
            try:
                found = re.fullmatch(r"socket:\[(\d+)\]", os.readlink(link))
            except OSError:
                continue
            if found:
                owners[found[1]] = line
    found = []
    for kind in ("tcp", "udp", "tcp6", "udp6"):
        for entry in Path(f"/proc/net/{kind}").read_text().splitlines()[1:]:
            fields = entry.split()
            if fields[9] in owners and (kind.startswith("udp") or fields[3] == "0A"):
                found.append((kind, fields[1].partition(":")[0], owners[fields[9]]))
    return found


def test_a_simulation_reports_readiness_listens_locally_and_reports_the_first_death(tmp_path: Path) -> None:
    command = Command(tmp_path, "launch", "multi_vehicle", "vehicles:=iris:2", "--instance", "5")
    command.wait_for("ready: iris:2; world empty; 1 x real time; 1 participant; ROS master http://127.0.0.1:")
    assert "UDP ground stations 21270-21271 -> 17250; offboard 37280-37281 -> 27240-27241" in command.output
    command.wait_for("estimators ready")
    sockets = _sockets(command.running())
    assert sum(kind == "udp" for kind, _, _ in sockets) >= 8  # three of each autopilot, and MAVROS's
    # roscpp's XML-RPC server listens on all interfaces, whatever ROS_IP is; here it is rosout's
    open_ends = [(kind, line) for kind, address, line in sockets if address != "0100007F"]
    assert [kind for kind, line in open_ends if "rosout/rosout" in line] == ["tcp"]
    assert [end for end in open_ends if "rosout/rosout" not in end[1]] == []
    simulator = next(pid for pid, line in command.running().items() if "/simulator.py " in line)
    os.kill(simulator, signal.SIGKILL)
    assert command.end() == 1
    dead = [line.strip() for line in command.output.splitlines() if " has died (" in line]
    assert dead[0].startswith("simulator has died (SIGKILL)"), command.output
    assert command.running() == {}


# ---- a demo that cannot start


def _files() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))


def _memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (700_000 << 10, 700_000 << 10))


@pytest.mark.parametrize(("limits", "advice"), [(_files, "ulimit -n"), (_memory, "")])
def test_a_demo_without_means_ends_with_a_line(tmp_path: Path, limits: Callable[[], None], advice: str) -> None:
    command = Command(tmp_path, "demo", "formation", "--n", "2", "--headless", limits=limits)
    assert command.end() == 1
    assert re.search(r"^(Error|xtdrone): ?.*", command.output, re.MULTILINE), command.output
    assert advice in command.output
    assert command.running() == {}


# stand-in for roslaunch; its children ignore signals, like hanging nodes
STUBBORN = """\
#!{python}
import signal, socket, subprocess, sys, time
[signal.signal(number, signal.SIG_IGN) for number in (2, 15)]
{master}
subprocess.Popen([sys.executable, "-c", "import signal, time; [signal.signal(s, signal.SIG_IGN) for s in (2, 15)];"
    "print('started', flush=True); time.sleep(600)"], start_new_session=True)
time.sleep(600)
"""
MUTE = "server = socket.create_server(('127.0.0.1', int(sys.argv[sys.argv.index('-p') + 1])))"
IMPATIENT = """\
import sys
from xtdrone_interaction import cli
from xtdrone_interaction.missions.formation import cli as formation_cli
from xtdrone_interaction.launching import supervised_launch
from xtdrone_interaction.launching import process_tree
process_tree._STEPS = tuple((s, 0.3) for s, _ in process_tree._STEPS)
process_tree._ORPHANED = process_tree._TERMINATED = 0.3
supervised_launch._PATIENCE = 0.3
formation_cli._START_LIMIT, formation_cli._START_LIMIT_VEHICLE = 3.0, 0.0
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize("then", ["mute master", "kill -9"])
def test_a_demo_whose_launch_hangs_is_ended(tmp_path: Path, then: str) -> None:
    """It ends if the master accepts connections and never replies, and if it is killed while nodes ignore signals."""
    program = STUBBORN.format(python=sys.executable, master=MUTE if then == "mute master" else "")
    path = fake_roslaunch.install(tmp_path, program)
    environment = {**os.environ, "PATH": path, "XTDRONE_TEST_LAUNCH": str(tmp_path)}
    arguments = ["demo", "formation", "--n", "2", "--headless", "--out", str(tmp_path / "out")]
    with (tmp_path / "output.txt").open("w") as output:
        demo = subprocess.Popen([sys.executable, "-c", IMPATIENT, *arguments], env=environment, stdout=output)
    command = Command.__new__(Command)
    command.mark, command.file, command.process = f"XTDRONE_TEST_LAUNCH={tmp_path}", tmp_path / "output.txt", demo
    if then == "kill -9":
        command.wait_for("starting the nodes")
        demo.kill()
        demo.wait()
        assert command.gone()
        return
    assert command.end() == 1
    assert re.search(r"no progress for 3 s of wall time; the ROS master at \S+ does not answer", command.output)
    assert command.running() == {}


@pytest.mark.parametrize("needs_all", [True, False])
def test_a_missed_join_ends_a_demo_and_is_shown_in_a_launch(
    needs_all: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervised_launch, "_LOGS_PERIOD", 0.0)
    launch = supervised_launch.Launch("x.launch", {}, tmp_path, 11311, True, needs_all=needs_all)
    launch.log.parent.mkdir()
    line = "simulator: time starts without all participants after 120 s: 1 of 2 participants have not joined: /script"
    launch.log.write_text(f"[WARN] [1.0]: {line}\n")
    notes: list[str] = []
    display = SimpleNamespace(note=notes.append, standstill=notes.append)
    feed = SimpleNamespace(take=lambda _: [], lost=False)
    watch = supervised_launch.Watch(SimpleNamespace(), launch, feed, display, EndedNodes(launch.log))
    if needs_all:
        with pytest.raises(supervised_launch.DemoError, match=re.escape(line)):
            watch.poll(starting=True)
    else:
        watch.poll(starting=True)
        assert line in notes[0]


@pytest.mark.parametrize(
    ("variables", "named"),
    [
        ({"ROS_IP": "127.0.0.1"}, ""),
        ({"ROS_HOSTNAME": "localhost", "ROS_IP": "no.such.host.invalid"}, ""),  # the host's name comes first
        ({"ROS_IP": "no.such.host.invalid"}, "ROS_IP is 'no.such.host.invalid'"),
        ({"ROS_HOSTNAME": "no.such.host.invalid", "ROS_IP": "127.0.0.1"}, "ROS_HOSTNAME is 'no.such.host.invalid'"),
        ({"ROS_HOSTNAME": "", "ROS_IP": ""}, ""),
    ],
)
def test_an_address_under_which_nodes_do_not_find_each_other_is_named(variables: dict[str, str], named: str) -> None:
    refused = pytest.raises(supervised_launch.DemoError, match=named) if named else contextlib.nullcontext()
    with refused:
        supervised_launch._check_own_address(variables)


def test_a_mute_master_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        uri = f"http://127.0.0.1:{server.getsockname()[1]}"
        monkeypatch.setenv("ROS_MASTER_URI", uri)
        with pytest.raises(command_options.OptionError, match=re.escape(uri)):
            master_port(None, use_running=True)


WITHOUT_PAGE = {
    "bench.launch": "measures speed",
    "bench_free.launch": "measures speed",
    "bench_search.launch": "measures speed",
    "bench_web.launch": "measures what the page costs, with and without it",
    "bridges.launch": "beside a running flight, as web.launch",
    "mavros.launch": "a part of a flight, on another machine",
    "record.launch": "beside a running flight",
    "rviz.launch": "beside a running flight",
    "vehicle.launch": "one more vehicle in a running flight, whose page shows it",
    "web.launch": "the page itself",
}
"""Launch files without ``web:=true``, and why."""


def test_each_flight_has_its_page() -> None:
    files = sorted((command_options.repository() / "launch").glob("*.launch"))
    without = {file.name for file in files if '<arg name="web" default' not in file.read_text(encoding="utf-8")}
    assert without == set(WITHOUT_PAGE)
