"""Kinds of flight: of each the demo with its options, the director, the record, its metrics and its figures."""
