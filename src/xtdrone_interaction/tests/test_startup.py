"""What counts as movement while a launch starts, and what is said of the usual causes that keep it from starting."""

from __future__ import annotations

from pathlib import Path

import pytest

from xtdrone_interaction.hints import advice
from xtdrone_interaction.startup import Startup


class Logs:
    """A folder of logs that grow."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.startup = Startup(folder)

    def add(self, text: str, name: str = "run/simulator-2-stdout.log") -> bool:
        """Add to a log and return whether that moves."""
        path = self._folder / name
        path.parent.mkdir(exist_ok=True)
        with path.open("a") as file:
            file.write(text)
        return self.startup.look()


@pytest.fixture
def logs(tmp_path: Path) -> Logs:
    return Logs(tmp_path)


def test_a_line_moves_once_whatever_the_time(logs: Logs) -> None:
    line = "[INFO] [{}, 0.0]: simulator: holding time at 0: {} of 20 participants have joined\n"
    assert logs.add(line.format(1795250671.65, 7))
    assert not logs.startup.look()
    assert not logs.add(line.format(1795250676.65, 7))
    assert logs.add(line.format(1795250681.65, 8))
    assert logs.add("[WARN] [1.5]: /a has been silent for 3 s\n")
    assert not logs.add("[WARN] [9.5]: /a has been silent for 9.0 s\n")
    assert not logs.add("half a li")
    assert logs.add("ne\n")


def test_a_kernel_moves_for_as_long_as_it_is_compiled(logs: Logs) -> None:
    logs.add("[WARN] [1.5]: simulator: compiling kernels: estimator.update; once for this version\n", "roslaunch.log")
    assert logs.startup.compiling == "compiling kernels: estimator.update; once for this version"
    assert logs.startup.look()
    assert logs.startup.look()
    logs.add("[INFO] [9.5]: simulator: kernel compiled: estimator.update, in 8.0 s\n")
    assert not logs.startup.look()


def test_what_the_simulator_says_of_the_start_is_understood(logs: Logs) -> None:
    logs.add("process[rosout-1]: started with pid [5]\nprocess[simulator-2]: started with pid [7]\n", "roslaunch.log")
    assert (logs.startup.started, logs.startup.runs, logs.startup.joined) == (1, False, None)
    logs.add("[INFO] [1.5, 0.0]: simulator: 5 participants have joined, time starts\n")
    logs.add("[INFO] [1.5, 0.0]: simulator: iris_0 to iris_1 stand ready, time runs; Ctrl-C ends it\n")
    assert (logs.startup.runs, logs.startup.joined) == (True, 5)


def test_advice_is_given_for_what_is_known() -> None:
    assert advice("[INFO] all is well") == []
    assert "--instance" in advice("FATAL: iris_1 ground-station link: UDP port 18571 cannot be bound")[0]
    assert "ulimit -n" in advice("OSError: [Errno 24] Too many open files")[0]
