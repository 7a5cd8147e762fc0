"""Replay check: the same flight flown under other conditions is the same to the last bit."""
