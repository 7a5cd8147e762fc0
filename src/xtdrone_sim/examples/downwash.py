"""Downwash: the wake of each vehicle pushes vehicles below it. A function, compiled by numba.

roslaunch launch/multi_vehicle.launch vehicles:=iris:2 effects:="[$PWD/src/xtdrone_sim/examples/downwash.py:downwash]"
"""

import math

from numba import njit

AIR = 1.2  # kg/m^3
ROTOR_RADIUS = 0.127  # m
SPREAD = 0.1  # m of wake radius gained per metre of fall
DRAG = 1.0  # drag coefficient of the body's top, referred to its box


@njit(cache=True)
def downwash(time, vehicles, models, force, torque):
    """Add 1/2 rho Cd A w^2 downwards, where w is the wake's speed at the lower vehicle.

    The wake of an actuator disc contracts to twice the induced speed, then spreads as a jet with a Gaussian profile.
    """
    for i in range(len(vehicles)):
        m = models[i]
        thrust = m.thrust_constant * (vehicles[i].rotor_speed ** 2).sum()
        far_speed = math.sqrt(2.0 * thrust / (AIR * m.rotor_count * math.pi * ROTOR_RADIUS**2))
        for j in range(len(vehicles)):
            dx, dy, dz = vehicles[i].position - vehicles[j].position
            if dz > 0.0:
                radius = m.radius + SPREAD * dz
                speed = far_speed * m.radius / radius * math.exp(-(dx * dx + dy * dy) / radius**2)
                top = models[j].box[0] * models[j].box[1]
                force[j, 2] -= 0.5 * AIR * DRAG * top * speed * speed
