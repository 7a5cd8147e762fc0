"""The demos of ``./xtdrone demo``: the commands, their flights and their reports."""
