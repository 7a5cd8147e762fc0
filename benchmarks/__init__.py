"""Benchmarks of the simulator and of the stack above it; nothing under ``src/`` depends on them."""
