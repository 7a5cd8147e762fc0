#!/usr/bin/env python3
"""The server: gives time to nodes in lockstep, as fast as they can take it: ``server.py NODES SECONDS``."""

import sys

import rosgraph

from xtdrone_lockstep.server import LockstepServer

nodes, seconds = int(sys.argv[1]), float(sys.argv[2])
server = LockstepServer()
master = rosgraph.Master("lockstep_server")
master.setParam("/lockstep/uri", server.uri)
try:
    server.wait_for(nodes, progress=print)
    now_us = 0
    while now_us is not None and now_us <= seconds * 1e6:
        server.tick(now_us)
        now_us = server.next_due_us(now_us)
finally:
    master.deleteParam("/lockstep/uri")
    server.close()
