from typing import Any

class Settings:
    def __init__(
        self,
        gain: float,
        normalise: bool,
        limit: float,
        avoids: bool,
        avoidance_gain: float,
        radius: float,
        clearance: float,
    ) -> None: ...

class FollowerTurn:
    def __init__(
        self,
        id: int,
        settings: Settings,
        offsets: list[tuple[float, float, float]],
        weights: list[tuple[int, float]],
    ) -> None: ...
    def ignore(self, pattern: bytes, topology: bytes) -> None: ...
    def carry_out(
        self,
        hover_speed: float,
        timeout: float,
        hovering: bool,
        moving_since: float,
        packet: bytes,
        mode: str | None,
        armed: bool,
    ) -> None: ...
    def program(self) -> Any: ...
    def take(self, time_us: int, received: list[list[bytes]], sequences: list[int]) -> list[bytes] | None: ...
    @property
    def turns(self) -> int: ...
    @property
    def states(self) -> list[float]: ...
    @property
    def pose(self) -> list[float]: ...
    @property
    def command(self) -> list[float]: ...
    @property
    def avoidance(self) -> list[float]: ...
