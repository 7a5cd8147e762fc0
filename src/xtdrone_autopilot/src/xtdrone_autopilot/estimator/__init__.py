"""State estimation (PX4: ekf2, landing_target_estimator)."""
