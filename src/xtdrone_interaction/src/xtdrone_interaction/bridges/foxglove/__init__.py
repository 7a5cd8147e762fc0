"""A live bridge to Foxglove and Lichtblick by foxglove-sdk: topics with ROS 1's schemas, parameters, services, graph."""
