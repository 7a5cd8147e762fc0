"""Fixtures of several files."""

from __future__ import annotations

from graph_of_nodes import graph, server

__all__ = ["graph", "server"]
