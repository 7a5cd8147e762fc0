#!/usr/bin/env python3
"""A follower written once: tested with a thousand UAVs, then flown in full physics and on a real UAV::

python src/xtdrone_swarm/examples/thousand.py [film.mp4]        # the simplified simulator, without ROS

here=$PWD/src/xtdrone_swarm/examples/thousand.py
roslaunch launch/formation.launch n:=9 follower_class:=$here  # pybullet, PX4's control, ROS
rosrun xtdrone_coordination follower.py iris 1 9 _class:=$here    # on a UAV with MAVROS, for vehicle 1 of 9
"""

import sys

from xtdrone_coordination.follower import Follower


class GentleFollower(Follower):
    """Consensus whose velocity grows with the square root of the distance beyond a metre."""

    def control_law(self, position, peers):
        """Return the velocity of the paper's equation 2, compressed above 1 m/s, m/s ENU."""
        velocity = super().control_law(position, peers)
        length = sum(v * v for v in velocity) ** 0.5
        return [v / max(length, 1.0) ** 0.5 for v in velocity]


if __name__ == "__main__":
    from xtdrone_swarm import Swarm  # not needed by the follower, and possibly not installed on a UAV

    swarm = Swarm(1000, follower=GentleFollower, follower_options={"vel_max": 3.0}, altitude=100.0)
    for pattern in ("cube", "pyramid"):
        swarm.choose(pattern)
        settled = swarm.run_until(settled=0.3, hold=2.0, limit=120.0)
        word = "settled" if settled else "not settled"
        print(f"{pattern}: {word} at {swarm.time:.1f} s, worst error {swarm.errors().max():.2f} m")
    if sys.argv[1:]:
        swarm.film(sys.argv[1], speed=4.0)
