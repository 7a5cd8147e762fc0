"""``python -m xtdrone_interaction NAME ...``, started by ``./xtdrone``."""

from xtdrone_interaction.cli import start

if __name__ == "__main__":  # worker processes import this file, too
    start()
