"""The state of a running launch, read from its logs and messages."""
