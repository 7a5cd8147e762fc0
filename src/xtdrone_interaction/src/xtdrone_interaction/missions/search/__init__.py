"""The cooperative search for people."""
