"""Paths through a map, without time: searched on the local grid."""
