"""Requests to the running simulator: pause, step, speed, resets, joining and leaving vehicles, wind."""
