"""Commands of the page to vehicles, swarm and simulated time."""
