"""XTDrone's keyboard: commands to vehicles from a terminal."""
