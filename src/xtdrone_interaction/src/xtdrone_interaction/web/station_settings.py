"""Settings of the station."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.server_guard import names_setting, origins_setting

DEFAULT_PORT = 8642


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
    token_file: str = setting(
        "",
        metavar="FILE",
        text="file of mode 600 with the token to operate, in place of the environment variable XTDRONE_WEB_TOKEN; "
        "without either one is generated if needed",
    )
    origins: tuple[str, ...] = origins_setting()
    names: tuple[str, ...] = names_setting()
    view_only: bool = setting(False, text="pages may only watch, not operate")
    rate: float = setting(
        10.0, low=0.5, high=30.0, unit="Hz", text="frame rate of the fleet in wall time", metavar="HZ"
    )
    recordings: str = setting("", metavar="FOLDER", text="folder of recordings; empty: runs in the workspace")
