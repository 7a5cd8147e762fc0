"""The command line of the ground station, ``./xtdrone gcs``: a module per group of commands."""
