"""Commands to vehicles, swarm and simulated time that the page gives."""
