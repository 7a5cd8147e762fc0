"""Use of the aiding sensors by the estimator: sources, timeouts, validity (PX4: ekf2's control)."""
