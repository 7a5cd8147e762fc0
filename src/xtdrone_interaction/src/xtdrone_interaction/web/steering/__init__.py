"""Keyboard and gamepad of a page, which fly vehicles or the leader."""
