"""Steps of a fleet without contacts: several steps of all vehicles in one call, on several threads.

While no vehicle is near the ground or another body, the vehicles are independent of each other between two contact
checks, and each can make several steps at once. Vehicles far from all others need no check for up to 0.1 s. The results
are those of ``Simulation.step`` to the last bit, with any number of threads.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Sequence
from itertools import pairwise
from queue import SimpleQueue
from typing import Any

import numpy as np

from xtdrone_autopilot.autopilot import STEP_US, Autopilot
from xtdrone_autopilot.autopilot import step_vehicle as control
from xtdrone_autopilot.state import N_STATES
from xtdrone_sim.kernel import kernel, kernel_for_threads, kernel_that_allocates
from xtdrone_sim.physics.contacts.contact_states import CHECK_STEPS, sort_contacts
from xtdrone_sim.physics.vehicle_dynamics import ASLEEP, TOUCHING, rotor_lag
from xtdrone_sim.physics.vehicle_dynamics import step_vehicle as move
from xtdrone_sim.physics.world import World
from xtdrone_sim.sensors.sensor_models import FLOW_EVERY, STEPS, Sensors, sample_vehicle

_VEHICLES_PER_THREAD = 12  # fewer are completed before another thread would have started
_MOST_THREADS = 8
_LONGEST = 25  # steps without a contact check

_Call = tuple[Callable[..., object], tuple[Any, ...]]


@kernel
def _is_free(plant, armed, failures, failed, excluded):
    """Return whether all vehicles fly free or sleep, no unit fails, and the mixers exclude the ``failed`` rotors."""
    for i in range(plant.shape[0]):
        contact = plant[i].contact
        if contact == TOUCHING or (contact == ASLEEP and armed[i]) or failed[i] != excluded[i]:
            return False
    return not np.any(failures)


@kernel_for_threads
def _advance(
    first, last, steps, step, time_us, plant, models, field, place, gravity, dt, bias, fast, slow, down, below,
    sensors, estimator, setpoint, control_records, params, mix, unmix, rotors, work,
):  # fmt: skip
    """Advance the vehicles ``first`` to ``last`` (excluded) by ``steps``.

    Args:
        first, last, steps: integers.
        step: number of the first step since the start.
        time_us: simulated time before it, microseconds.
        plant, models: see ``plant.step_all``.
        field, place, gravity, dt, bias, fast, slow, down, below: see ``sensor_models.sample_all``.
        sensors, estimator, setpoint, control_records, params, mix, unmix, rotors, work: see ``autopilot.step_all``.
    """
    for i in range(first, last):
        v, m, s = plant[i], models[i], sensors[i]
        e, goal, c, p = estimator[i], setpoint[i], control_records[i], params[i]
        lag = rotor_lag(m, dt)
        for k in range(steps):
            move(v, m, lag, c.actuators, goal.armed, gravity, dt)
            sample_vehicle(
                i, s, v, m, bias[i], fast[i], slow[i], down[i], below,
                step + k, time_us + (k + 1) * STEP_US, field, place, gravity, dt,
            )  # fmt: skip
            control(s, e, goal, c, p, mix[i], unmix[i], rotors[i], dt, work)


@kernel_that_allocates
def _advance_alone(most, step, time_us, plant, models, field, place, gravity, dt, *records):
    """Advance all vehicles by up to ``most`` steps, until a contact check finds a change; return the number of steps.

    Args:
        most: number of steps, 1 or more; the contacts have been checked for the first ones.
        step: number of the first step since the start; the contacts are checked before multiples of CHECK_STEPS.
        time_us: simulated time before it, microseconds.
        plant, models, field, place, gravity, dt, records: see ``_advance``.
    """
    count = plant.shape[0]
    wanted = np.empty(count, np.int64)
    armed = records[7]["armed"]
    done = 0
    while done < most:
        if done and sort_contacts(plant, models, armed, CHECK_STEPS, dt, wanted):
            return done
        steps = min(most - done, CHECK_STEPS - (step + done) % CHECK_STEPS)
        _advance(
            0, count, steps, step + done, time_us + done * STEP_US,
            plant, models, field, place, gravity, dt, *records,
        )  # fmt: skip
        done += steps
    return done


class _Thread:
    """A thread that calls functions without results; it ends with this object."""

    def __init__(self, number: int) -> None:
        """Start the thread."""
        self._calls: SimpleQueue[_Call | None] = SimpleQueue()
        self._ends: SimpleQueue[BaseException | None] = SimpleQueue()
        arguments = self._calls, self._ends
        threading.Thread(target=_serve, args=arguments, name=f"free_flight_{number}", daemon=True).start()
        weakref.finalize(self, self._calls.put, None)

    def begin(self, function: Callable[..., object], arguments: tuple[Any, ...]) -> None:
        """Start a call."""
        self._calls.put((function, arguments))

    def wait(self) -> None:
        """Wait for its end; raise the exception that it has raised, if any."""
        error = self._ends.get()
        if error is not None:
            raise error


def _serve(calls: SimpleQueue[_Call | None], ends: SimpleQueue[BaseException | None]) -> None:
    while (call := calls.get()) is not None:
        function, arguments = call
        try:
            function(*arguments)
            ends.put(None)
        except BaseException as error:
            ends.put(error)


class FreeFlight:
    """Compiled steps of a simulation's vehicles.

    Attributes:
        sensors: sensor models.
    """

    def __init__(self, world: World, sensors: Sensors, autopilot: Autopilot, threads: int | None = None) -> None:
        """Prepare the steps.

        Args:
            world: bodies, of which ``plant`` is advanced.
            sensors: sensor models, which write to the autopilots.
            autopilot: records of the autopilots.
            threads: number of threads, 1 or more; None: chosen by the numbers of vehicles and processors.
        """
        count = len(world.plant)
        if threads is None:
            threads = min(len(os.sched_getaffinity(0)), count // _VEHICLES_PER_THREAD, _MOST_THREADS)
        self.sensors = sensors
        self._world, self._autopilot = world, autopilot
        self._failures = autopilot.failures.view(np.int32)
        self._armed, self._failed = autopilot.setpoint["armed"], autopilot.setpoint["failed_rotors"]
        limits = [count * i // max(threads, 1) for i in range(max(threads, 1) + 1)]
        self._limits = list(pairwise(limits))
        self._below: tuple[Any, ...] = ()
        self._share_out()
        self._threads = [_Thread(i) for i in range(1, len(self._shares))]

    def _share_out(self) -> None:
        """Collect the arguments of the kernels; repeated if the objects below the vehicles have changed."""
        if self._below is self.sensors.below.arrays:
            return
        self._below = self.sensors.below.arrays
        world, sensors, a, model = self._world, self.sensors, self._autopilot, self._world.model
        records = (
            world.plant, world.models, world.magnetic_field, sensors.place, model.gravity, world.time_step,
            *sensors.noise, self._below,
            a.sensors, a.estimator, a.setpoint, a.control, a.params, a.mix, a.unmix, a.rotors,
        )  # fmt: skip
        self._shares = [(first, last, (*records, np.zeros((2, N_STATES)))) for first, last in self._limits]

    @property
    def _checks_inside(self) -> bool:
        """Whether the kernel checks the contacts."""
        return not self._threads and not self._world.has_obstacles

    def _possible_steps(self, most: int) -> int:
        """Return the number of steps, up to ``most``, for which the vehicles are free.

        These are the steps to the next contact check, or more if no earlier check can find a contact, or 0.
        """
        if self.sensors.failing.any:
            return 0
        steps = min(self._world.check_contacts(self._armed), most)
        if self._world.is_busy:
            return 0
        if not _is_free(self._world.plant, self._armed, self._failures, self._failed, self._autopilot.failed_rotors):
            return 0
        if self._checks_inside or steps == most:
            return steps
        return max(steps, self._world.steps_apart(min(most, _LONGEST)))

    def advance(self, most: int, step: int, time_us: int) -> int:
        """Advance plant, sensors and autopilots while the vehicles are free.

        Args:
            most: largest number of steps, 1 or more.
            step: number of the first one since the start.
            time_us: simulated time before it, microseconds.

        Returns:
            The number of steps, up to ``most``; 0 if the next one must be done by ``Simulation.step``.
        """
        most = min(most, STEPS - step % STEPS)
        if self.sensors.below.sees_others:  # samples that depend on other vehicles are left to ``Simulation.step``
            most = min(most, -step % FLOW_EVERY)
            if not most:
                return 0
        steps = self._possible_steps(most)
        if not steps:
            return 0
        if step % STEPS == 0:
            self._on_all_threads(self.sensors.draw_block, self._limits)
        if not self.sensors.below.sees_others:
            self.sensors.below.update(time_us)
        self._share_out()
        if self._checks_inside:
            steps = int(_advance_alone(most, step, time_us, *self._shares[0][2]))
        else:
            calls = [(first, last, steps, step, time_us, *records) for first, last, records in self._shares]
            self._on_all_threads(_advance, calls)
        self._world.count_steps(steps)
        return steps

    def _on_all_threads(self, function: Callable[..., object], calls: Sequence[tuple[Any, ...]]) -> None:
        """Call ``function`` with the arguments of each thread's call, the first on this thread, and wait for all."""
        first, *others = calls
        for thread, arguments in zip(self._threads, others, strict=True):
            thread.begin(function, arguments)
        try:
            function(*first)
        finally:
            for thread in self._threads:
                thread.wait()
