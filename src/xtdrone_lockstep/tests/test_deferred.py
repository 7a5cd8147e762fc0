"""Background work: results are available at their simulation time, whenever the work is completed."""

from __future__ import annotations

import threading

import pytest

from xtdrone_lockstep.deferred_work import Deferred, Done


@pytest.fixture
def gate():
    event = threading.Event()
    yield event
    event.set()


def test_results_are_available_when_due_and_in_order(gate):
    deferred = Deferred(workers=2)
    deferred.put("late", 300, lambda: "done long before")
    deferred.put("b", 200, lambda x: gate.wait(10.0) and x, 2)
    deferred.put("a", 100, lambda: 1)
    assert deferred.ready(99) == []
    assert deferred.ready(100) == [Done("a", 1)]
    assert len(deferred) == 2
    threading.Timer(0.05, gate.set).start()
    assert deferred.ready(300) == [Done("b", 2), Done("late", "done long before")]  # waits for the gate
    assert (deferred.ready(1000), len(deferred)) == ([], 0)
    deferred.close()


def test_without_lockstep_nothing_waits(gate):
    deferred = Deferred(wait=False)
    deferred.put("a", 0, gate.wait, 10.0)
    assert deferred.ready(10) == []
    gate.set()
    deferred._work[0].future.exception(10.0)
    assert deferred.ready(10) == [Done("a", True)]
    deferred.close()


def test_discarded_work_yields_no_result(gate):
    deferred = Deferred()
    deferred.put("a", 0, gate.wait, 10.0)
    deferred.put("b", 0, lambda: 1)
    deferred.clear()
    deferred.put("c", 5, lambda: 2)
    gate.set()
    assert deferred.ready(5) == [Done("c", 2)]
    deferred.close()


def test_exception_is_raised_in_place_of_the_result():
    deferred = Deferred()
    deferred.put("a", 10, lambda: 1 // 0)
    assert deferred.ready(9) == []
    with pytest.raises(ZeroDivisionError):
        deferred.ready(10)
    with pytest.raises(ValueError, match="max_workers"):
        Deferred(0)
    deferred.close()
