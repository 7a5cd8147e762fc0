"""``./xtdrone sweep``: fly the runs of a study, on all cores or on a cluster."""
