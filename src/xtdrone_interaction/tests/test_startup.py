"""Progress of a starting launch, and messages on the usual causes of a failed start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from xtdrone_interaction.monitoring.ended_nodes import EndedNode
from xtdrone_interaction.monitoring.launch_log_errors import advice, error_lines
from xtdrone_interaction.monitoring.missing_nodes import nodes, not_joined
from xtdrone_interaction.monitoring.startup_progress import Startup


class Logs:
    """A folder of logs that grow."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.startup = Startup(folder)

    def add(self, text: str, name: str = "run/simulator-2-stdout.log") -> bool:
        """Append to a log; return whether the progress changes."""
        path = self._folder / name
        path.parent.mkdir(exist_ok=True)
        with path.open("a") as file:
            file.write(text)
        return self.startup.update()


@pytest.fixture
def logs(tmp_path: Path) -> Logs:
    return Logs(tmp_path)


def test_a_line_is_redrawn_once_at_any_time(logs: Logs) -> None:
    line = "[INFO] [{}, 0.0]: simulator: holding time at 0: {} of 20 participants have joined\n"
    assert logs.add(line.format(1795250671.65, 7))
    assert not logs.startup.update()
    assert not logs.add(line.format(1795250676.65, 7))
    assert logs.add(line.format(1795250681.65, 8))
    assert logs.add("[WARN] [1.5]: /a has been silent for 3 s\n")
    assert not logs.add("[WARN] [9.5]: /a has been silent for 9.0 s\n")
    assert not logs.add("half a li")
    assert logs.add("ne\n")


def test_a_kernel_moves_for_as_long_as_it_is_compiled(logs: Logs) -> None:
    logs.add("[WARN] [1.5]: simulator: compiling kernels: estimator.update; once for this version\n", "roslaunch.log")
    assert logs.startup.compiling == "compiling kernels: estimator.update; once for this version"
    assert logs.startup.update()
    assert logs.startup.update()
    logs.add("[INFO] [9.5]: simulator: kernel compiled: estimator.update, in 8.0 s\n")
    assert not logs.startup.update()


def test_the_simulators_start_messages_are_parsed(logs: Logs) -> None:
    logs.add("process[rosout-1]: started with pid [5]\nprocess[simulator-2]: started with pid [7]\n", "roslaunch.log")
    assert (logs.startup.started, logs.startup.runs, logs.startup.joined) == (1, False, None)
    logs.add("[INFO] [1.5, 0.0]: simulator: 5 participants have joined, time starts\n")
    logs.add("[INFO] [1.5, 0.0]: simulator: iris_0 to iris_1 are ready, time runs; Ctrl-C ends it\n")
    assert (logs.startup.runs, logs.startup.joined) == (True, 5)


_NODES = """\
PARAMETERS
 * /follower_1/class:

NODES
  /
    follower_1 (xtdrone_coordination/follower_consensus.py)
    leader (xtdrone_coordination/leader.py)
    recorder (rosbag/record)
    simulator (xtdrone_sim/simulator.py)
  /team/
    mine (my_package/mine.py)
    other (my_package/mine.py)

auto-starting new master
process[simulator-2]: started with pid [1]
process[leader-3]: started with pid [1]
process[team/mine-4]: started with pid [{pid}]
"""


def test_nodes_that_have_not_joined_are_reported_with_their_state(tmp_path: Path) -> None:
    log = tmp_path / "run" / "team-mine-4-stdout.log"
    log.parent.mkdir()
    log.write_text("reading the map\n")
    lines = _NODES.format(pid=os.getpid()).splitlines()
    assert nodes(lines) == ["follower_1", "leader", "team/mine", "team/other"]
    dead = {"leader": EndedNode("leader", None, "has died (exit code 1)", "/a/leader.log")}
    words = not_joined(lines, ["/team/other"], dead, tmp_path)
    assert words.split("; ") == [
        "follower_1 was never started", "leader has died (exit code 1), see /a/leader.log",
        f"team/mine runs, see {log}",
    ]  # fmt: skip
    assert not_joined(lines, ["/follower_1", "/leader", "/team/mine", "/team/other"], {}, tmp_path) == ""
    assert "team/mine is gone" in not_joined(_NODES.format(pid=1 << 30).splitlines(), [], {}, tmp_path)


def test_a_stopped_node_behind_its_launcher_is_reported(tmp_path: Path) -> None:
    with (
        subprocess.Popen(["sleep", "99"]) as node,
        subprocess.Popen(
            ["/x/node_launcher", "-cprint(flush=True); input()", str(node.pid)],
            executable=sys.executable,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as launcher,
    ):
        assert launcher.stdout is not None
        launcher.stdout.readline()  # the command line of a starting program is empty for a moment
        node.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, node.pid, os.WSTOPPED)
        words = not_joined(_NODES.format(pid=launcher.pid).splitlines(), [], {}, tmp_path)
        node.kill()
        launcher.kill()
    assert "team/mine is stopped (SIGSTOP), see" in words


def test_advice_is_given_for_known_errors() -> None:
    assert advice("[INFO] all is well") == []
    assert "--instance" in advice("FATAL: iris_1 ground-station link: UDP port 18571 cannot be bound")[0]
    assert "ulimit -n" in advice("OSError: [Errno 24] Too many open files")[0]


_LOG = """\
[rosout-1] process[simulator-2]: started with pid [5]
[ERROR] [1.5, 0.0]: iris_0: FCU: Failsafe activated
[ERROR] [1.5, 0.0]: iris_0: FCU: Failsafe activated
Traceback (most recent call last):
  File "/a/node.py", line 7, in main
    raise OptionError("ERROR: no such thing") from error
[INFO] [2.5, 0.0]: leader: another node's line
subprocess.TimeoutExpired: Command 'x' timed out
Exception ignored in: <function Socket.__del__ at 0x7f>
Traceback (most recent call last):
  File "/a/socket.py", line 9, in __del__
    raise ValueError
ValueError: closed
terminate called after throwing an instance of 'std::bad_alloc'
  what():  std::bad_alloc
[follower_1-8] process has died [pid 9, exit code -9, cmd /a/follower.py].
================REQUIRED process [{node}] has died!
process has {how}
log file: /a/{node}*.log
Initiating shutdown!
================
[recorder-4] killing on exit
[ERROR] [3.5, 9.0]: leader: the simulator is gone
"""
_SHOWN = [
    "[ERROR] [1.5, 0.0]: iris_0: FCU: Failsafe activated",
    "subprocess.TimeoutExpired: Command 'x' timed out",
    "terminate called after throwing an instance of 'std::bad_alloc'",
    "what():  std::bad_alloc",
    "[follower_1-8] process has died [pid 9, exit code -9, cmd /a/follower.py].",
]


def test_shortcomings_list_failures_only() -> None:
    done = _LOG.format(node="formation_director-11", how="finished cleanly")
    assert error_lines(done.splitlines()) == _SHOWN
    how = "died [pid 7, exit code -11, cmd /a/simulator.py]."
    died = _LOG.format(node="simulator-2", how=how)
    assert error_lines(died.splitlines()) == [*_SHOWN, "REQUIRED process [simulator-2] has died!", f"process has {how}"]
    assert error_lines(["[ INFO] all is well", '    log.error("ERROR")']) == []
