"""Pictures of a swarm: off-screen, as a film or in a window. Matplotlib is needed only here."""

from xtdrone_swarm.view.film import FilmError, FilmWriter, check_film, film
from xtdrone_swarm.view.swarm_picture import Frame, SwarmView, palette
from xtdrone_swarm.view.window_and_mouse import Window, WindowError, can_open

__all__ = [
    "FilmError",
    "FilmWriter",
    "Frame",
    "SwarmView",
    "Window",
    "WindowError",
    "can_open",
    "check_film",
    "film",
    "palette",
]
