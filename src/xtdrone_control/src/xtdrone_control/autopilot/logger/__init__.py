"""PX4's logger: flights written as ULog files."""
