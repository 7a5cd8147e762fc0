"""Roles of a page: watch only, or operate, which includes watching."""

from __future__ import annotations

from typing import Literal

Role = Literal["view", "operate"]
