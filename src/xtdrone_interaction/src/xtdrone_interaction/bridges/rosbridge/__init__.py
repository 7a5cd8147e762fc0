"""A server of the rosbridge protocol, version 2, for programs on roslibjs, roslibpy and their like."""
