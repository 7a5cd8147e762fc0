"""Maps of the surroundings: what is free, occupied or unknown around a vehicle, and how far the next obstacle is."""
