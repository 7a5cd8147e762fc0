"""Uniform cubic B-splines: their values, limits and optimisation."""
