"""``python -m xtdrone_swarm.view TYPE NUM``: ``visualize.py`` as a Python module, to be started by programs."""

import signal
import sys

if __name__ == "__main__":
    # The imports take seconds, and some of them suppress a KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    from xtdrone_swarm.view.view_of_ros_flight import main

    sys.exit(main())
