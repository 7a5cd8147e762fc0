"""People seen during a search: candidates, second looks, finds."""
