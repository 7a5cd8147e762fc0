"""The node's side of the lockstep; ``xtdrone_lockstep`` exports its public names."""
