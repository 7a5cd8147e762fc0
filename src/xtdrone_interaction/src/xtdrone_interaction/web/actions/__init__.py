"""What the users of pages do: it acts between two ticks, is recorded, and can be replayed on another simulation."""
