"""``./xtdrone doctor``: what keeps the vehicles of a running simulation from arming, flying or being heard."""
