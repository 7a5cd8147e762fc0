"""A live bridge to Foxglove and Lichtblick by foxglove-sdk: topics, parameters, services."""
