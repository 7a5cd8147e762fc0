"""Python programs and nodes: command lines and exit status, log, end with roslaunch, start from the zygote, user code."""
