"""Telemetry: content of the messages, and the times at which each link sends them."""
