"""``python -m xtdrone_interaction COMMAND``: what ``./xtdrone`` starts. Ctrl-C is quiet from the first moment on."""

import signal
import sys

if __name__ == "__main__":  # worker processes import this file, too
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # while modules are loaded there is nothing to clean up
    from xtdrone_interaction.cli import main

    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        sys.exit(main())
    except KeyboardInterrupt:  # before or after the time in which a command takes signals itself
        print("xtdrone: stopped by SIGINT", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
