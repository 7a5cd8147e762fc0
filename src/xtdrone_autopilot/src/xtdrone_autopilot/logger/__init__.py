"""PX4's logger: flight logs in ULog format."""
