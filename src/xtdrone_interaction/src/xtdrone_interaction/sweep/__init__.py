"""``./xtdrone sweep``: thousands of flights over parameters and seeds, on all cores or on a cluster."""
