"""Lidars: ray patterns, scans and their messages, and the node."""
