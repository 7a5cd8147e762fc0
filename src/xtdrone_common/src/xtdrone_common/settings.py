"""Declare a setting once: default, range, unit and meaning.

A class of settings is a frozen dataclass whose fields are declared with :func:`setting`::

    @dataclass(frozen=True)
    class FollowerOptions(Settings):
        Kp: float = setting(1.0, above=0.0, unit="1/s", text="gain of the consensus law")

The declaration checks every instance, reads ROS parameters (:meth:`Settings.from_parameters`), adds command-line
options (:meth:`Settings.add_arguments`) and documents itself (:meth:`Settings.table`). An error names the setting, its
value and what is allowed: ``Kp: -1 is not allowed, above 0 1/s``. This module does not import ROS.
"""

from __future__ import annotations

import math
import sys
from argparse import SUPPRESS, Action, ArgumentParser, ArgumentTypeError, Namespace, _ArgumentGroup
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from typing import Any, NamedTuple, Self

_KEY = "xtdrone setting"
_INTEGER_TEXT = "a whole number"
_TEXTS = "tuple[str, ...]"


class SettingError(ValueError):
    """A value that is not allowed.

    Attributes:
        name: the setting, as the user wrote it.
        value: the rejected value.
        allowed: what is allowed, with the unit.
    """

    def __init__(self, name: str, value: object, allowed: str) -> None:
        super().__init__(f"{name}: {value!r} is not allowed, {allowed}")
        self.name, self.value, self.allowed = name, value, allowed


class _Declaration(NamedTuple):
    """The arguments of :func:`setting`, without the default."""

    low: float | None
    high: float | None
    above: float | None
    below: float | None
    choices: tuple[Any, ...]
    unit: str
    text: str
    check: Callable[[Any], object] | None
    parse: Callable[[Any], Any] | None
    allowed: str
    ros: str | None
    option: str | None
    metavar: str | None
    positional: bool

    @property
    def infinite(self) -> bool:
        """Whether infinity is allowed."""
        return any(limit is not None and math.isinf(limit) for limit in (self.low, self.high))

    def contains(self, value: float) -> bool:
        """Return whether a number is finite, unless infinity is allowed, and within the limits."""
        return (
            (math.isfinite(value) or (self.infinite and not math.isnan(value)))
            and (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def range(self) -> str:
        """Return the limits with the unit, such as ``2 to 200 m``; empty without limits."""
        low, high = _finite(self.low), _finite(self.high)
        if low is not None and high is not None:
            limits = f"{format_value(low)} to {format_value(high)}"
        else:
            words = (("at least", low), ("above", self.above), ("at most", high), ("below", self.below))
            limits = " and ".join(f"{word} {format_value(limit)}" for word, limit in words if limit is not None)
        return f"{limits} {self.unit}".strip() if limits else ""


def setting(
    default: Any,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    choices: Sequence[Any] | None = None,
    unit: str = "",
    text: str,
    check: Callable[[Any], object] | None = None,
    parse: Callable[[Any], Any] | None = None,
    allowed: str = "",
    ros: str | None = None,
    option: str | None = None,
    metavar: str | None = None,
    positional: bool = False,
) -> Any:
    """Declare a field of a class of settings.

    Args:
        default: value of a setting that is not given; ``...`` if it has to be given.
        low, high: inclusive limits; an infinite one permits infinity, which is an error otherwise.
        above, below: exclusive limits.
        choices: the allowed values.
        unit: of the value, such as ``m/s``. Unit and limits of a tuple of numbers are those of each number.
        text: meaning, one phrase without unit, range and default.
        check: further check, called with a value of the right type; raises ValueError whose text says which values are
            allowed, such as ``a multiple of 32 px``.
        parse: returns the value for a ROS parameter or the text of an option; raises ValueError as ``check`` does. The
            default is then not part of the option's help text.
        allowed: description of the allowed values for messages and documentation, if type and limits are not enough.
        ros: name of the ROS parameter; the field's name by default.
        option: command-line option; the field's name with hyphens by default, ``--no-NAME`` for a flag that is true.
        metavar: placeholder of the option's value in the help text; that of a positional argument, which messages
            name, is the field's name in capitals by default.
        positional: whether it is a positional argument of the command line rather than an option.
    """
    declaration = _Declaration(
        low,
        high,
        above,
        below,
        tuple(choices or ()),
        unit,
        text,
        check,
        parse,
        allowed,
        ros,
        option,
        metavar,
        positional,
    )
    return field(default=default, metadata={_KEY: declaration})


class _Setting(NamedTuple):
    """A declared field of a class of settings.

    Attributes:
        name: of the field.
        kind: ``bool``, ``int``, ``float``, ``str``, ``tuple[float, ...]`` with each element written out,
            ``tuple[str, ...]``, or another annotation, which is not checked.
        optional: whether None is allowed.
        default: value if none is given.
        declared: the rest of the declaration.
    """

    name: str
    kind: str
    optional: bool
    default: Any
    declared: _Declaration

    @property
    def parameter(self) -> str:
        """Name of the ROS parameter."""
        return self.declared.ros or self.name

    def allowed(self) -> str:
        """Return what is allowed, with the unit, for messages."""
        if self.declared.allowed:
            return self.declared.allowed
        if self.kind == "bool":
            return "true or false"
        if self.declared.choices:
            *first, last = map(format_value, self.declared.choices)
            return f"{', '.join(first)} or {last}" if first else last
        limits = self.declared.range()
        if self.kind == "int":
            return f"{_INTEGER_TEXT}{' from' if ' to ' in limits else ','} {limits}" if limits else _INTEGER_TEXT
        if self.kind == "float":
            return limits or f"a finite number in {self.declared.unit}".removesuffix(" in ")
        if self._length:
            return f"{self._length} numbers, {limits or self.declared.unit}"
        return "a list of texts" if self.kind == _TEXTS else limits or "text"

    def checked(self, value: Any) -> Any:
        """Return an allowed value, numbers as ``int`` or ``float``.

        Raises:
            SettingError: the value is not allowed.
        """
        if value is None and self.optional:
            return None
        if not self._is_allowed(value):
            raise SettingError(self.name, None if value is ... else value, self.allowed())
        value = self._converted(value)
        if self.declared.check is not None:
            try:
                self.declared.check(value)
            except ValueError as error:
                raise SettingError(self.name, value, self.declared.allowed or str(error)) from error
        return value

    @property
    def _length(self) -> int:
        """Number of elements of a tuple of numbers, else 0."""
        return self.kind.count("float") if self.kind.startswith("tuple") else 0

    def _is_allowed(self, value: Any) -> bool:
        if self.declared.choices and value not in self.declared.choices:
            return False
        if self._length:
            return isinstance(value, (tuple, list)) and len(value) == self._length and all(map(self._is_number, value))
        if self.kind == _TEXTS:
            return isinstance(value, (tuple, list)) and all(isinstance(element, str) for element in value)
        if self.kind == "int":
            return isinstance(value, Integral) and self._is_number(value)
        if self.kind == "float":
            return self._is_number(value)
        expected = {"bool": bool, "str": str}.get(self.kind)
        return expected is None or isinstance(value, expected)

    def _is_number(self, value: Any) -> bool:
        return type(value) is not bool and isinstance(value, Real) and self.declared.contains(float(value))

    def _converted(self, value: Any) -> Any:
        if self._length:
            return tuple(map(float, value))
        convert: dict[str, Callable[[Any], Any]] = {"int": int, "float": float, _TEXTS: tuple}
        return convert.get(self.kind, lambda same: same)(value)

    def read(self, value: Any) -> Any:
        """Return the value that a ROS parameter or a mapping gives, not yet checked.

        Raises:
            SettingError: it cannot be parsed.
        """
        if self.declared.parse is not None:
            try:
                return self.declared.parse(value)
            except ValueError as error:
                raise SettingError(self.name, value, self.declared.allowed or str(error)) from error
        # ROS reads the name of a file called 7 as a number.
        return str(value) if self.kind == "str" and type(value) in (int, float) else value

    def parsed(self, text: str) -> Any:
        """Return the value of a command-line option.

        Raises:
            ArgumentTypeError: the text is not an allowed value.
        """
        convert = self.declared.parse or {"int": int, "float": float}.get(self.kind, str)
        try:
            return self.checked(convert(text))
        except SettingError as error:
            raise ArgumentTypeError(f"{text!r} is not allowed, {error.allowed}") from error
        except ValueError as error:
            allowed = self.declared.allowed or (str(error) if self.declared.parse else self.allowed())
            raise ArgumentTypeError(f"{text!r} is not allowed, {allowed}") from error

    def add_to(self, parser: ArgumentParser | _ArgumentGroup) -> Action:
        """Add the command-line option, or the positional argument."""
        hyphened = self.name.replace("_", "-")
        if self.declared.positional:
            return parser.add_argument(
                self.name,
                type=self.parsed,
                nargs=None if self.default is ... else "?",
                default=self.default,
                metavar=self.declared.metavar or self.name.upper(),
                help=self._help(),
            )
        if self.kind == "bool":
            option = self.declared.option or (f"--no-{hyphened}" if self.default else f"--{hyphened}")
            action = "store_false" if self.default else "store_true"
            return parser.add_argument(
                option, action=action, dest=self.name, default=SUPPRESS, help=_escaped(self.declared.text)
            )
        return parser.add_argument(
            self.declared.option or f"--{hyphened}",
            type=self.parsed,
            choices=self._choices() or None,
            dest=self.name,
            default=SUPPRESS,
            metavar=self.declared.metavar,
            help=self._help(),
        )

    def _choices(self) -> tuple[Any, ...]:
        """Return the allowed values that are written literally on a command line."""
        return self.declared.choices if self.declared.parse is None else ()

    def _help(self) -> str:
        """Return the help text of an argument: meaning, range with unit, default."""
        limits = self.allowed() if self.declared.range() and not self._choices() else ""
        words = [self.declared.text, self.declared.allowed or limits or self.declared.unit]
        shown = self.declared.parse is None and self.default not in (None, "", ...)
        return _escaped(", ".join(filter(None, words)) + f" (default: {format_value(self.default)})" * shown)

    def row(self) -> str:
        """Return the row of the Markdown table."""
        has_range = self.declared.choices or self.declared.allowed or self.kind == "bool"
        limits = self.allowed() if has_range else self.declared.range().removesuffix(self.declared.unit).rstrip()
        meaning = self.declared.text.replace("``", "`")
        cells = (f"`{self.parameter}`", format_value(self.default), limits, self.declared.unit, meaning)
        return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


@dataclass(frozen=True)
class Settings:
    """Base class of settings; fields that are not declared with :func:`setting` are left alone."""

    def __post_init__(self) -> None:
        """Check the declared settings and convert numbers to their declared type.

        A subclass that restricts combinations overrides this, calls it first, and raises :class:`SettingError` too.

        Raises:
            SettingError: a value is not allowed.
        """
        for declared in _declared(type(self)):
            object.__setattr__(self, declared.name, declared.checked(getattr(self, declared.name)))

    @classmethod
    def from_parameters(
        cls, get: Callable[[str, Any], Any], prefix: str = "~", names: Collection[str] | None = None, **others: Any
    ) -> Self:
        """Return the settings that ROS parameters give.

        Args:
            get: ``rospy.get_param``, or another function of a name and a default.
            prefix: of the parameters' names.
            names: fields to read; all by default.
            others: values of fields that are not read from parameters.

        Raises:
            SettingError: a value is not allowed; the message names the parameter as ROS resolves it.
        """
        declared = [s for s in _declared(cls) if s.name not in others and (names is None or s.name in names)]
        given = {s.name: get(f"{prefix}{s.parameter}", s.default) for s in declared}
        return cls._read(given, others, lambda s: _resolved(get, f"{prefix}{s.parameter}"))

    @classmethod
    def from_mapping(cls, given: object, name: str, **others: Any) -> Self:
        """Return the settings that a mapping gives, such as a nested ROS parameter or a part of a YAML file.

        Args:
            given: values by the fields' names; settings that are missing keep their defaults.
            name: of the mapping, for messages.
            others: fields that the mapping must not have.

        Raises:
            SettingError: not a mapping, an unknown name, or a value that is not allowed.
        """
        known = [s.name for s in _declared(cls) if s.name not in others]
        if not isinstance(given, Mapping) or not set(given) <= set(known):
            raise SettingError(name, given, f"a mapping with {', '.join(known)}")
        return cls._read(given, others, lambda s: f"{name} {s.name}")

    @classmethod
    def _read(cls, given: Mapping[str, Any], others: Mapping[str, Any], name_of: Callable[[_Setting], str]) -> Self:
        """Return settings of unparsed values; errors have the name that ``name_of`` returns."""
        declared = {s.name: s for s in _declared(cls)}
        try:
            values = {
                name: value if value is declared[name].default else declared[name].read(value)
                for name, value in given.items()
            }
            return cls(**values, **others)
        except SettingError as error:
            if error.name not in given:
                raise
            raise SettingError(name_of(declared[error.name]), error.value, error.allowed) from error

    @classmethod
    def add_arguments(
        cls, parser: ArgumentParser | _ArgumentGroup, names: Collection[str] | None = None
    ) -> dict[str, Action]:
        """Add an option for each declared setting to a parser.

        Args:
            parser: gets the options, and reports arguments that are not allowed.
            names: fields that get an option, in this order; all by default.

        Returns:
            The options by the fields' names.
        """
        declared = {s.name: s for s in _declared(cls)}
        return {name: declared[name].add_to(parser) for name in (declared if names is None else names)}

    @classmethod
    def from_arguments(cls, namespace: Namespace, **others: Any) -> Self:
        """Return the settings of a parsed command line; those without an option keep their defaults.

        Args:
            namespace: result of a parser with :meth:`add_arguments`.
            others: further fields, which take precedence.

        Raises:
            SettingError: a value is not allowed.
        """
        given = {s.name: getattr(namespace, s.name) for s in _declared(cls) if hasattr(namespace, s.name)}
        return cls(**{**given, **others})

    @classmethod
    def table(cls, names: Collection[str] | None = None) -> str:
        """Return a Markdown table with name, default, range, unit and meaning of each setting.

        Args:
            names: fields of the table; all declared ones by default.
        """
        head = ("| name | default | range | unit | meaning |", "|---|---|---|---|---|")
        return "\n".join((*head, *(s.row() for s in _declared(cls) if names is None or s.name in names)))


def check_range(name: str, value: Any, low: float, high: float = math.inf, unit: str = "") -> float:
    """Return ``value``, which is not a field of a class of settings, if it is a finite number within its limits.

    Args:
        name: of the value where the user has written it.
        value: of any type.
        low, high: inclusive limits.
        unit: of the value, for the message.

    Raises:
        SettingError: not a finite number, or outside the limits.
    """
    if type(value) in (float, int) and low <= value <= high and math.isfinite(value):
        return float(value)
    return float(_single(name, "float", setting(0.0, low=low, high=_finite(high), unit=unit, text="")).checked(value))


def check_choice(name: str, value: str, allowed: Sequence[str]) -> str:
    """Return ``value``, which is not a field of a class of settings, if it is one of ``allowed``.

    Raises:
        SettingError: it is none of them.
    """
    return str(_single(name, "str", setting("", choices=allowed, text="")).checked(value))


def _single(name: str, kind: str, declared: Any) -> _Setting:
    return _Setting(name, kind, False, declared.default, declared.metadata[_KEY])


def format_value(value: object) -> str:
    """Return a value as a user writes it: ``true``, ``0.5``, ``hold``."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.15g}"
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(format_value, value))}]"
    return "" if value is None else str(value)


def _declared(cls: type[Settings]) -> tuple[_Setting, ...]:
    return tuple(
        _Setting(entry.name, *_kind(entry.type), entry.default, entry.metadata[_KEY])
        for entry in fields(cls)
        if _KEY in entry.metadata
    )


def _kind(annotation: Any) -> tuple[str, bool]:
    """Return an annotation's text without None, and whether None is part of it."""
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    parts = [part.strip() for part in text.split("|")]
    return " | ".join(part for part in parts if part != "None"), "None" in parts


def _resolved(get: Callable[..., Any], name: str) -> str:
    rospy = sys.modules.get("rospy")
    return str(rospy.resolve_name(name)) if rospy is not None and get is rospy.get_param else name


def _finite(limit: float | None) -> float | None:
    return None if limit is None or math.isinf(limit) else limit


def _escaped(text: str) -> str:
    return text.replace("%", "%%")
