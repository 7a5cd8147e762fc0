"""What a vehicle perceives: objects and people in images, tags, positions of others, and its own motion."""
