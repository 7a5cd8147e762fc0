"""The browser station: a page on the running flight, and the server behind it."""
