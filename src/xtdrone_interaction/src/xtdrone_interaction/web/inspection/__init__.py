"""Rooms in place of rqt's plug-ins: topics and echo, plots, console, parameters, node graph, images."""
