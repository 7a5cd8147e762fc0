"""``xtdrone gcs``."""

import sys

from .command_line.gcs_cli import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
