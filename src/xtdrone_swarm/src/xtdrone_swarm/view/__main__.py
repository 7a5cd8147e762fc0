"""``python -m xtdrone_swarm.view TYPE NUM``: ``visualize.py`` for those who start it from a program."""

import signal
import sys

if __name__ == "__main__":
    # The imports take seconds and some of them swallow a KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    from xtdrone_swarm.view.ros import main

    sys.exit(main())
