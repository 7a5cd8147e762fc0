"""The node's side of the lockstep; ``xtdrone_control.lockstep`` exports its public names."""
