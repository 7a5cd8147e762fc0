"""Radios of vehicles: range, delay, jitter, loss and bandwidth, for samples of states and for messages on topics."""
