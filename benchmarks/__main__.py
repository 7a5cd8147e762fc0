"""``python -m benchmarks bench ...``, started by ``./xtdrone bench``."""

from xtdrone_interaction.cli import start

if __name__ == "__main__":  # worker processes import this file, too
    start()
