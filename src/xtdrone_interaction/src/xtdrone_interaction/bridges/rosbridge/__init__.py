"""Server of the rosbridge protocol, version 2, for roslibjs, roslibpy and similar clients."""
