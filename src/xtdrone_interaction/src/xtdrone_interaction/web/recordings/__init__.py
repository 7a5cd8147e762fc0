"""Recordings: started, stopped, opened and played."""
