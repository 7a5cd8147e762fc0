"""Plans of a search: the region, its division and the paths that cover it."""
