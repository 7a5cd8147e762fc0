"""ROS nodes that the benchmarks' launch files start, and the libraries behind them."""
