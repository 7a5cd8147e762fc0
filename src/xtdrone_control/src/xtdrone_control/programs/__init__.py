"""Python programs and nodes: arguments and exit status, log, end with roslaunch, start by the zygote, user code."""
