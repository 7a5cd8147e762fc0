"""What all tests share: draws of Hypothesis that depend on nothing but the test."""

from __future__ import annotations

try:
    import hypothesis
    from hypothesis.internal.conjecture import providers
except ImportError:
    pass
else:
    # No wall time decides, and the same examples are drawn in each run.
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
