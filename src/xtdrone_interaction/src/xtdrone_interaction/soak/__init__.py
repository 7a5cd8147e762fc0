"""A soak: one simulation runs for hours while flights and clients come and go; its growth and pace are judged."""
