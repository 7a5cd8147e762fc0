"""The fleet's binary frame, channel 1: poses and velocities of everything that moves.

Little-endian; offsets in bytes, of the whole frame with its first byte:

======  ==========  ==========================================================================
offset  type        value
======  ==========  ==========================================================================
0       uint8       1, the channel
1       uint8       1, the version of this layout
2       uint16      n, number of vehicles
4       uint16      m, number of other models that move: robots, people, moved things
6       uint16      0
8       float64     simulated time, s
16      uint32      version of the roster (``fleet.roster``) whose order the rows have
20      uint32      number of the frame
24      float32     (n + m) rows of x, y, z (m ENU), quaternion w, x, y, z, velocity vx, vy, vz (m/s)
======  ==========  ==========================================================================

``web_page/fleet_frame.js`` reads it.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

CHANNEL = 1
_VERSION = 1
_HEADER = struct.Struct("<BHHHdII")  # after the channel


def pack_fleet_frame(
    vehicles: NDArray[np.float64], movers: NDArray[np.float64], time: float, roster: int, number: int
) -> bytes:
    """Return a frame without its first byte, which the session adds.

    Args:
        vehicles, movers: shape (n, 10) and (m, 10), columns as above; NaN for what is unknown.
        time: simulated, s.
        roster: version of the roster.
        number: of the frame.
    """
    header = _HEADER.pack(_VERSION, len(vehicles), len(movers), 0, time, roster, number)
    return header + np.concatenate([vehicles, movers]).astype("<f4").tobytes()
