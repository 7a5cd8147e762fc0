"""States of a searching vehicle, and what each does in a turn."""
