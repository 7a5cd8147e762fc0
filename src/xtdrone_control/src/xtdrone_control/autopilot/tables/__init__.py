"""PX4 v1.14's tables as CSV: parameters, their labels and former names, logged messages, events."""
