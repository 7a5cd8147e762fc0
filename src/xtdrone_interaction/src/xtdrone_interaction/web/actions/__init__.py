"""Operators' actions on pages: applied between two ticks, recorded, and replayable on another simulation."""
