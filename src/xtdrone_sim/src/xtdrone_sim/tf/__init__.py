"""TF frames of the vehicles, and the node that publishes them."""
