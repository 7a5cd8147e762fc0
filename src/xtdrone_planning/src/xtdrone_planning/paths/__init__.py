"""Geometric paths through a map, found on the local grid."""
