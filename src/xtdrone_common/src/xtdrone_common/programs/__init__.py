"""Python programs and nodes: arguments, exit status, log, shutdown with roslaunch, start by the zygote, user code."""
