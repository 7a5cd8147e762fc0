"""Settings of the station."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.settings import Settings, setting

DEFAULT_PORT = 8642


def _checked_token(token: str) -> None:
    if token and (len(token) < 8 or not all(c.isalnum() or c in "-_" for c in token)):
        raise ValueError("8 or more letters, digits, - and _, or empty")


@dataclass(frozen=True)
class StationSettings(Settings):
    """Private parameters of the node, and options of ``./xtdrone web``."""

    host: str = setting(
        "127.0.0.1",
        metavar="ADDRESS",
        text="listening address; 127.0.0.1: this machine only; another one, as 0.0.0.0, needs the token of the URL",
    )
    port: int = setting(
        DEFAULT_PORT,
        low=0,
        high=65535,
        metavar="PORT",
        text="TCP port; 0: any free one; if it is in use: the next free one; the default is 540 N higher for "
        "instance N",
    )
    token: str = setting("", check=_checked_token, metavar="TEXT", text="token to operate; empty: generated if needed")
    view_only: bool = setting(False, text="pages may only watch, not operate")
    rate: float = setting(
        10.0, low=0.5, high=30.0, unit="Hz", text="frame rate of the fleet in wall time", metavar="HZ"
    )
    recordings: str = setting("", metavar="FOLDER", text="folder of recordings; empty: runs in the workspace")
