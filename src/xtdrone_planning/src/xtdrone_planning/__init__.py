"""Maps of the surroundings, paths and trajectories through them, and safety filters of setpoints."""
