"""Human interaction layer: the demo's director, its display, flight records, reports and plots."""
