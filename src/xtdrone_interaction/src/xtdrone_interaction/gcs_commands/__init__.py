"""``./xtdrone gcs``: the commands of the ground station, one module per group of commands."""
