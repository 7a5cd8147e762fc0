"""After the installation has compiled the kernels, flights compile none: they are there for the types of flight."""

from __future__ import annotations

import importlib
import pkgutil

import numpy as np
from numba.core.dispatcher import Dispatcher
from test_flown_trajectories import GuardedFlight, GuardedGroup
from test_level_navigation import Drive, random_map
from toy_flight import ToyFlight, forest
from toy_floor import ToyFloor, rooms

import xtdrone_planning
from xtdrone_control.network.network_options import NetworkOptions
from xtdrone_planning import compile_kernels
from xtdrone_planning.planner_settings import AgreementSettings


def kernels() -> dict[str, Dispatcher]:
    """Return all kernels of the package, by name."""
    found = {}
    for module in pkgutil.walk_packages(xtdrone_planning.__path__, "xtdrone_planning."):
        if module.name.endswith("sampled_path"):  # loads OMPL
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, Dispatcher):
                found[f"{value.py_func.__module__}.{value.py_func.__name__}"] = value
    return found


def test_flights_compile_no_further_kernel():
    compile_kernels.main()
    before = {name: list(kernel.signatures) for name, kernel in kernels().items()}
    agreement = AgreementSettings(check=0.2)
    GuardedGroup(2, NetworkOptions(), agreement, length=16.0, trunks=forest(2, 30), kind=GuardedFlight).run(4.0)
    flight = ToyFlight(forest(1))
    flight.planner.set_goal(np.array([20.0, 0.0, 2.0]))
    flight.run(2.5)
    ToyFloor(rooms(0), [(1.0, 9.0), (1.0, 11.0)]).fly(4.0)
    drive = Drive(random_map(1), (1.0, 1.0, 0.3))
    drive.navigator.set_goal(np.array([19.0, 18.5, -2.0]))
    drive.run(1.0)
    after = {name: list(kernel.signatures) for name, kernel in kernels().items()}
    assert after == before
    assert sum(map(len, after.values())) > 20
