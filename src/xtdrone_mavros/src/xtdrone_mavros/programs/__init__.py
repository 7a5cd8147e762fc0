"""MAVROS's command-line programs: mavsys, mavcmd, mavparam, mavwp, mavsafety.

Verbs, arguments and formats are those of MAVROS 1.x (mavlink/mavros, branch master, ``mavros/scripts``), so the
programs work with this layer and with real MAVROS. In addition, each accepts ``--wait``, and an error is one line on
standard error and exit status 1.
"""
