"""Effects: a user's forces and torques on the vehicles, added between the rotors' wrench and the integration.

An effect is a callable with five arguments, called once a step for all vehicles::

    def lift(time, vehicles, models, force, torque):
        force[:, 2] += 0.5

============  ===================================================================================================
``time``      simulated time at the beginning of the step, s
``vehicles``  (n,) ``plant.PLANT``, read-only: the true state at the beginning of the step. Positions, velocities and
              forces are in the world frame (ENU), rates and torques in the body frame (FLU), quaternions (w, x, y, z)
              body to world. ``rotor_speed``, ``force`` and ``torque`` are already those of this step's rotors;
              ``force`` and ``torque`` include the effects before this one.
``models``    (n,) ``vehicle_model.MODEL``, read-only: mass, inertia, rotor layout and drag
``force``     (n, 3) N, ENU, at the centre of mass; zero at the call, the effect adds to it
``torque``    (n, 3) N m, FLU; zero at the call, the effect adds to it
============  ===================================================================================================

Effects are applied in the order in which they are listed. One with a state is an instance of a class with ``__call__``
and ``reset(models, time_step, random)``. ``reset`` is called at the start and after each restart of the world: it must
discard the state. ``random`` is a ``numpy.random.Generator`` of this effect's own, seeded by the world's seed and the
effect's name, so the same flight sees the same noise.

Cost, next to 11 us for a step of one vehicle and 75 us for one of 30: about 3 us for a function compiled by
``numba.njit``; 2 us for a plain Python function, and 1 to 3 us more for each numpy operation in it. A vehicle asleep on
the ground with its motors off is not moved. A row with ``contact`` ABSENT is a place without a vehicle, one
with LOST a vehicle that is out of the world until its reset.
"""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.programs.user_classes import import_user_module
from xtdrone_sim.physics.vehicle_dynamics import (
    ABSENT,
    ASLEEP,
    FREE,
    advance_rotors,
    integrate_free,
    rotor_lag,
    rotor_wrench,
)

from .air import AIR
from .kernel import kernel

Effect = Callable[[float, NDArray[Any], NDArray[Any], NDArray[np.float64], NDArray[np.float64]], object]

_ENTRY = "NAME, FILE.py:NAME, module:NAME or {one of them: {ARGUMENT: VALUE}}"
_SIGNATURE = "(time, vehicles, models, force, torque)"
_RESET_SIGNATURE = "(models, time_step, random)"


class EffectError(ValueError):
    """An effect that cannot be loaded or applied; the message names it."""


@kernel
def drive_rotors(plant, models, actuators, armed, dt):
    """Advance the rotors by ``dt`` and compute the wrench of every vehicle that is awake; see ``plant.step_all``."""
    for i in range(plant.shape[0]):
        v, m = plant[i], models[i]
        if v.contact >= ABSENT or (v.contact == ASLEEP and not armed[i]):
            continue
        advance_rotors(v, m, rotor_lag(m, dt), actuators[i], armed[i])
        rotor_wrench(v, m)


@kernel
def add_wrench(plant, armed, force, torque):
    """Add ``force`` (n, 3) and ``torque`` (n, 3) to the vehicles that are awake, and zero both.

    Returns:
        The index of a vehicle whose force or torque is not finite; -1 if there is none.
    """
    bad = -1
    for i in range(plant.shape[0]):
        v = plant[i]
        awake = v.contact < ABSENT and (v.contact != ASLEEP or armed[i])
        for k in range(3):
            if not (np.isfinite(force[i, k]) and np.isfinite(torque[i, k])):
                bad = i
            if awake:
                v.force[k] += force[i, k]
                v.torque[k] += torque[i, k]
            force[i, k] = 0.0
            torque[i, k] = 0.0
    return bad


@kernel
def integrate_all(plant, models, armed, gravity, dt):
    """Advance every vehicle in free flight by ``dt``; return how many Bullet has to integrate."""
    touching = 0
    for i in range(plant.shape[0]):
        v, m = plant[i], models[i]
        if v.contact >= ABSENT or (v.contact == ASLEEP and not armed[i]):
            continue
        if v.contact == FREE:
            integrate_free(v, m, gravity, dt)
        else:
            touching += 1
    return touching


class Effects:
    """The effects on one world's vehicles.

    Attributes:
        names: names of the effects, in the order of application; the second of a name is called ``name_2``.
    """

    def __init__(self, effects: Sequence[Effect]) -> None:
        """Check the effects' signatures.

        Args:
            effects: in the order of application. An attribute ``name`` (a string) is the effect's name; without it, the
                name of its function or class is used.

        Raises:
            EffectError: an effect cannot be called with the arguments it gets.
        """
        self._effects = tuple(effects)
        self.names = _names(self._effects)
        for name, effect in zip(self.names, self._effects, strict=True):
            _check_effect(name, effect)

    def begin(
        self, plant: NDArray[Any], models: NDArray[Any], *, time_us: int = 0, step_us: int = 4000, seed: int = 0
    ) -> None:
        """Reset every effect for a new world, and try it once.

        The trial compiles kernels and finds errors before the flight. Its results are dropped, and effects with
        ``reset`` are reset again after it.

        Args:
            plant: (n,) ``PLANT``, the world's own, changed by ``apply``.
            models: (n,) ``MODEL``.
            time_us: simulated time, microseconds.
            step_us: one step, microseconds.
            seed: seed of the effects' random generators.

        Raises:
            EffectError: an effect raises, or returns a force or torque that is not finite.
        """
        self._plant = plant
        self._vehicles, self._models = _read_only(plant), _read_only(models)
        self._force, self._torque = np.zeros((len(plant), 3)), np.zeros((len(plant), 3))
        self._time_us, self._step_us = time_us, step_us
        for k, effect in enumerate(self._effects):
            feel = getattr(effect, "feel", None)
            if feel is not None:
                feel([one for one in self._effects[:k] if hasattr(one, "winds")])
        trial, armed = plant.copy(), np.zeros(len(plant), np.int32)
        for name, effect in zip(self.names, self._effects, strict=True):
            self._reset(name, effect, seed)
            self._call(name, effect, trial, armed)
            self._reset(name, effect, seed)

    def apply(self, armed: NDArray[np.int32]) -> None:
        """Add the effects' forces and torques to ``plant`` for the step that begins now.

        Args:
            armed: (n,) non-zero when motors run.

        Raises:
            EffectError: as for ``begin``.
        """
        for name, effect in zip(self.names, self._effects, strict=True):
            self._call(name, effect, self._plant, armed)
        self._time_us += self._step_us

    def _reset(self, name: str, effect: Effect, seed: int) -> None:
        reset = getattr(effect, "reset", None)
        if reset is None:
            return
        random = np.random.default_rng([seed, zlib.crc32(name.encode())])
        try:
            reset(self._models, self._step_us * 1e-6, random)
        except Exception as error:
            raise EffectError(f"effect {name}: reset() has failed: {_describe(error)}") from error

    def _call(self, name: str, effect: Effect, plant: NDArray[Any], armed: NDArray[np.int32]) -> None:
        time = self._time_us * 1e-6
        try:
            effect(time, self._vehicles, self._models, self._force, self._torque)
        except Exception as error:
            raise EffectError(f"effect {name}: failed at {time:.3f} s: {_describe(error)}") from error
        bad = add_wrench(plant, armed, self._force, self._torque)
        if bad >= 0:
            raise EffectError(f"effect {name}: force or torque on vehicle {bad} is not finite at {time:.3f} s")


def load_effects(entries: object, what: str = "effects") -> list[Effect]:
    """Return the effects that a parameter lists.

    Args:
        entries: a list. Each entry is a name of ``air.AIR``, ``"FILE.py:NAME"`` or ``"module:NAME"``, or a mapping of
            one such text to the arguments of a class or factory, as ``{"dryden": {"speed": 7.7}}``. A function without
            arguments in the list is itself the effect; a class is instantiated.
        what: name of the parameter, for messages.

    Raises:
        EffectError: an entry cannot be read, imported or instantiated.
    """
    if not isinstance(entries, list):
        raise EffectError(f"{what}: {entries!r} is not allowed, a list of {_ENTRY}")
    return [_load_effect(entry, what) for entry in entries]


def _load_effect(entry: object, what: str) -> Effect:
    place, arguments = entry, None
    if isinstance(entry, Mapping) and len(entry) == 1:
        ((place, arguments),) = entry.items()
    path, _, name = str(place).rpartition(":")
    known = place in AIR or (isinstance(place, str) and path and name)
    if not known or not isinstance(arguments, (Mapping, type(None))):
        raise EffectError(f"{what}: {entry!r} is not allowed, {_ENTRY}; the names are {', '.join(AIR)}")
    try:
        found: Any = AIR[place] if place in AIR else getattr(import_user_module(path), name)
    except (Exception, SystemExit) as error:  # from the user's file
        raise EffectError(f"{what}: {place} cannot be loaded: {_describe(error)}") from error
    if arguments is None and not inspect.isclass(found):
        effect: Effect = found
        return effect
    try:
        made: Effect = found(**(arguments or {}))
    except Exception as error:
        raise EffectError(f"{what}: {place} with arguments {dict(arguments or {})}: {_describe(error)}") from error
    return made


def _names(effects: Sequence[Effect]) -> tuple[str, ...]:
    names: list[str] = []
    for effect in effects:
        own = getattr(effect, "name", None) or getattr(effect, "__name__", None) or type(effect).__name__
        count = sum(name.rpartition("_")[0] == own or name == own for name in names)
        names.append(str(own) if not count else f"{own}_{count + 1}")
    return tuple(names)


def _check_effect(name: str, effect: Effect) -> None:
    if inspect.isclass(effect):
        raise EffectError(f"effect {name}: is a class; pass an instance, {name}(...)")
    if not callable(effect):
        raise EffectError(f"effect {name}: cannot be called, it must have the signature {_SIGNATURE}")
    _check_signature(name, effect, _SIGNATURE, 5)
    reset = getattr(effect, "reset", None)
    if reset is not None:
        _check_signature(f"{name}: reset()", reset, _RESET_SIGNATURE, 3)


def _check_signature(name: str, function: Callable[..., Any], wanted: str, count: int) -> None:
    plain = getattr(function, "py_func", function)  # of a function compiled by numba
    try:
        signature = inspect.signature(plain)
    except ValueError:  # built in: the trial call finds out
        return
    try:
        signature.bind(*range(count))
    except TypeError:
        raise EffectError(f"effect {name}: the signature is {signature}, it must be {wanted}") from None


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view


def _describe(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
