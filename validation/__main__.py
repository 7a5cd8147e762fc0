"""``python -m validation COMMAND ...``: started by ``./xtdrone replay-check``, ``compare-px4`` and ``soak``."""

from xtdrone_interaction.cli import start

if __name__ == "__main__":  # worker processes import this file, too
    start()
