"""The cooperative search as a demo: preparation, flight, options."""
