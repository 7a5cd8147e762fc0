"""The rooms that rqt's plug-ins are elsewhere: topics and echo, plots, console, parameters, node graph, images."""
