"""The formation flight as a demo: on the full stack, and simplified."""
