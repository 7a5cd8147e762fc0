"""Soak: one simulation for hours, with flights and clients that start and stop; its growth and pace are judged."""
