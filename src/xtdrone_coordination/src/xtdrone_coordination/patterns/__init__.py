"""Formation patterns: their slots, names and files. :class:`Patterns` is the entry."""

from .catalogue import Patterns, read_patterns, shipped_file
from .generated import origin_columns
from .names import PatternRequest, absolute_name, parse_name
from .slot_offsets_and_spacing import (
    DENSE_PITCH,
    MAX_SPACING,
    MIN_SEPARATION,
    PITCH,
    Offsets,
    PatternError,
    check_offsets,
    least_separation,
    rescaled,
    with_leader,
)

__all__ = [
    "DENSE_PITCH",
    "MAX_SPACING",
    "MIN_SEPARATION",
    "PITCH",
    "Offsets",
    "PatternError",
    "PatternRequest",
    "Patterns",
    "absolute_name",
    "check_offsets",
    "least_separation",
    "origin_columns",
    "parse_name",
    "read_patterns",
    "rescaled",
    "shipped_file",
    "with_leader",
]
