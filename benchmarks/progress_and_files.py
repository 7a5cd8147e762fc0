"""Progress output of the benchmark, and the file that it writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.calibration import describe
from xtdrone_common.files import write_whole


@contextmanager
def progress(console: Console, head: str) -> Iterator[Callable[[str], None]]:
    """Show the progress of a measurement: in place on a terminal, else only its start."""
    if not console.is_terminal:
        console.print(f"{head} ...", highlight=False, soft_wrap=True)
        yield lambda text: None
        return
    with console.status(head) as status:
        yield lambda text: status.update(f"{head}: {text}")


def print_machine(results: dict[str, Any], console: Console) -> None:
    """Print the facts of the machine and its calibration."""
    machine = results["machine"]
    console.print(
        f"{machine['cpu'] or 'unknown processor'}, {machine['cores']} cores, "
        f"{machine['memory_bytes'] / 2**30:.0f} GiB, {machine['system'] or 'unknown system'}, "
        f"Linux {machine['kernel']}, Python {machine['python']}, load {machine['load_before'][0]:.1f}",
        highlight=False,
        soft_wrap=True,
    )
    console.print(describe(results["calibration"]), highlight=False, soft_wrap=True)


def write_results(results: dict[str, Any], path: Path) -> None:
    """Write the file, which is complete at any time."""
    write_whole(path, json.dumps(results, indent=1) + "\n")
