"""Shared by all tests: the top-level packages in child processes, and repeatable draws of Hypothesis."""

from __future__ import annotations

import os
from pathlib import Path

# Programs that tests start import benchmarks and validation, as those that ./xtdrone starts do.
os.environ["PYTHONPATH"] = os.pathsep.join(
    filter(None, [os.environ.get("PYTHONPATH"), str(Path(__file__).resolve().parent)])
)

try:
    import hypothesis
    from hypothesis.internal.conjecture import providers
except ImportError:
    pass
else:
    # No deadlines by wall time, and the same examples in each run.
    hypothesis.settings.register_profile(
        "repeatable",
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[hypothesis.HealthCheck.too_slow],
    )
    hypothesis.settings.load_profile("repeatable")
    # Hypothesis also draws constants of all modules that happen to be loaded: of other tests', and of code just edited.
    providers.is_local_module_file = lambda path: False
