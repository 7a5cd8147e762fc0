"""Topics of the simulator: poses of links and people, states, contacts, IMUs, vehicles that join, and maps."""
