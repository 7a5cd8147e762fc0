"""MAVROS's programs for the command line: mavsys, mavcmd, mavparam, mavwp, mavsafety.

Verbs, arguments and formats are those of MAVROS 1.x (mavlink/mavros, branch master, ``mavros/scripts``), so they work
with any MAVROS: ours, which serves a fleet, or a real one. Beyond it, each takes ``--wait``, and what goes wrong is one
line on standard error and exit status 1.
"""
