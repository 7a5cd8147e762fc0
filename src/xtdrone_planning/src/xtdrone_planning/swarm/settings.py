"""Settings of multi-vehicle planning."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.settings import Settings, setting


@dataclass(frozen=True)
class AgreementSettings(Settings):
    """Coordination of trajectories between vehicles."""

    check: float = setting(
        0.4, low=0.0, high=5.0, unit="s",
        text="time for which a proposed trajectory is open to objections: at least the radio delay, plus 0.1 s for "
        "each message that may be lost",
    )  # fmt: skip
    separation: float = setting(
        0.4, low=0.0, high=10.0, unit="m", text="clearance between two planned vehicles, beyond their radii"
    )
    pause: float = setting(0.3, low=0.0, high=10.0, unit="s", text="time between a decision and the next proposal")
