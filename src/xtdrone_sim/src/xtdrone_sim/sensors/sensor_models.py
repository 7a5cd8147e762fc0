"""Sensor models of one vehicle, with noise from per-vehicle seeded streams.

IMU, magnetometer, barometer, GPS, and optionally an optical-flow camera and a range finder. These two face down to
level ground at height 0 and objects above it: models, other vehicles, people.

The noise of vehicle i depends only on the seed and on i, not on the size of the fleet; that of a vehicle that joins
also depends on the number of earlier vehicles at its place. The streams are drawn in blocks of one second in advance,
so the kernel only adds them; flow and range share a separate stream.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from xtdrone_autopilot.autopilot import Autopilot
from xtdrone_common.geodesy import projection
from xtdrone_common.rotation_kernels import multiply, rotate, rotate_inverse
from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.vehicle_dynamics import ABSENT
from xtdrone_sim.physics.world import World
from xtdrone_sim.rays.casting import distance_along
from xtdrone_sim.sensors.failing_sensors_and_motors import Failing
from xtdrone_sim.sensors.models_below import Below
from xtdrone_sim.sensors.vehicles_and_people_below import Others

STEPS = 250  # IMU samples per block of one second
MAG_EVERY = 5  # steps: 50 Hz; the other periods are multiples of it and divide STEPS
BARO_EVERY = 10  # 25 Hz
GPS_EVERY = 25  # 10 Hz
FLOW_EVERY = 10  # 25 Hz, optical flow and range
_FAST = 6  # normals per step: gyro 3, accel 3
_SLOW = 20  # normals per slot of MAG_EVERY steps: mag 3, baro 2, gps position 3, velocity 3, wander 3, IMU walks 6

_DOWN = 5  # normals per sample of flow and range: flow 2, its gyroscope 2, range 1
_DOWN_STREAM = 1  # second part of its spawn key
_JOINED = 2  # second part of the spawn keys of a vehicle that has joined; then the number of its join, and its streams
_BEST_FLOW = 255

BIAS = np.dtype(
    [
        ("rates", "f8", 3),  # rad/s, body FLU, true, of the previous step
        ("gyro", "f8", 3),  # rad/s, body FRD
        ("accel", "f8", 3),  # m/s^2
        ("mag", "f8", 3),  # gauss
        ("baro", "f8"),  # m
        ("gps", "f8", 3),  # m, NED
    ],
    align=True,
)

# International Standard Atmosphere, troposphere
_P0 = 101325.0  # Pa
_T0 = 288.15  # K
_LAPSE = 0.0065  # K/m
_THINNEST = 1e-3  # least share of that temperature: the model ends at 44 km
_EXPONENT = 5.25588

_reproject = kernel(projection.reproject)


@kernel
def _imu(s, v, m, b, noise, gravity, dt):
    """Sample gyroscope and accelerometer in body FRD; noise densities become sample noise by 1/sqrt(dt).

    Both are means over the step, as of an integrating IMU: rates between its ends, force in the attitude of its middle.
    """
    root = 1.0 / math.sqrt(dt)
    wx, wy, wz = 0.5 * (b.rates[0] + v.rates[0]), 0.5 * (b.rates[1] + v.rates[1]), 0.5 * (b.rates[2] + v.rates[2])
    for i in range(3):
        b.rates[i] = v.rates[i]
    middle = multiply(v.q, (1.0, -0.25 * dt * wx, -0.25 * dt * wy, -0.25 * dt * wz))  # half a step back; unit to 1e-6
    fx, fy, fz = rotate_inverse(middle, v.acceleration[0], v.acceleration[1], v.acceleration[2] + gravity)
    force = (fx, -fy, -fz)
    rates = (wx, -wy, -wz)
    for i in range(3):
        s.gyro[i] = rates[i] + b.gyro[i] + m.gyro_noise_density * root * noise[i]
        s.accel[i] = force[i] + b.accel[i] + m.accel_noise_density * root * noise[3 + i]


@kernel
def _walk_imu_biases(m, b, noise, dt):
    """Advance the random walk of the IMU biases by ``dt``; once per slot is enough for their slow rate."""
    root = math.sqrt(dt)
    for i in range(3):
        b.gyro[i] += m.gyro_random_walk * root * noise[14 + i]
        b.accel[i] += m.accel_random_walk * root * noise[17 + i]


@kernel
def _magnetometer(s, v, m, b, noise, field):
    x, y, z = rotate_inverse(v.q, field[0], field[1], field[2])
    s.mag[0] = x + b.mag[0] + m.mag_noise * noise[0]
    s.mag[1] = -y + b.mag[1] + m.mag_noise * noise[1]
    s.mag[2] = -z + b.mag[2] + m.mag_noise * noise[2]
    s.mag_fresh = 1


@kernel
def _barometer(s, v, m, b, noise, datum_altitude, dt):
    b.baro += m.baro_drift * math.sqrt(dt) * noise[4]
    altitude = datum_altitude + v.position[2] + b.baro + m.baro_noise * noise[3]
    share = max(1.0 - _LAPSE * altitude / _T0, _THINNEST)
    s.baro_alt = altitude
    s.baro_pressure = _P0 * share**_EXPONENT
    s.baro_temperature = _T0 * share - 273.15
    s.baro_fresh = 1


@kernel
def _ahead(v, i, time):
    """Return the position along world axis ``i`` in ``time`` s, extrapolated at constant acceleration, m."""
    return v.position[i] + time * (v.velocity[i] + 0.5 * time * v.acceleration[i])


@kernel
def _gps(s, v, m, b, noise, latitude, longitude, altitude, dt):
    """Sample position with white noise and a slow wander, and velocity with white noise."""
    keep = math.exp(-dt / m.gps_wander_time)
    drive = m.gps_wander * math.sqrt(1.0 - keep * keep)
    for i in range(3):
        b.gps[i] = keep * b.gps[i] + drive * noise[11 + i]
    north = _ahead(v, 1, m.gps_lead) + b.gps[0] + m.gps_horizontal_noise * noise[5]
    east = _ahead(v, 0, m.gps_lead) + b.gps[1] + m.gps_horizontal_noise * noise[6]
    down = -_ahead(v, 2, m.gps_lead) + b.gps[2] + m.gps_vertical_noise * noise[7]
    s.gps_lat, s.gps_lon = _reproject(north, east, latitude, longitude)
    s.gps_alt = altitude - down
    s.gps_vel[0] = v.velocity[1] + m.gps_lead * v.acceleration[1] + m.gps_velocity_noise * noise[8]
    s.gps_vel[1] = v.velocity[0] + m.gps_lead * v.acceleration[0] + m.gps_velocity_noise * noise[9]
    s.gps_vel[2] = -v.velocity[2] - m.gps_lead * v.acceleration[2] + m.gps_velocity_noise * noise[10]
    s.gps_eph = math.sqrt(m.gps_horizontal_noise**2 + m.gps_wander**2)
    s.gps_epv = math.sqrt(m.gps_vertical_noise**2 + m.gps_wander**2)
    s.gps_speed_accuracy = m.gps_velocity_noise
    s.gps_fix = 3
    s.gps_satellites = m.gps_satellites
    s.gps_hdop = m.gps_hdop
    s.gps_vdop = m.gps_vdop
    s.gps_fresh = 1


@kernel
def _range_finder(s, m, noise, distance):
    s.range_least = m.range_least
    s.range_largest = m.range_largest
    measured = distance + m.range_noise * noise[4]
    within = m.range_least <= measured <= m.range_largest
    s.range_distance = measured if within else m.range_largest
    s.range_quality = 100 if within else 0
    s.range_fresh = 1


@kernel
def _optical_flow(s, v, m, noise, distance, surface):
    """Sample the angular flow of a surface, including the camera's rotation; signs as in OPTICAL_FLOW_RAD.

    Args:
        s, v, m, noise: records, and (5,) normals.
        distance: distance of the surface, m.
        surface: its velocity, m/s, map.
    """
    vx, vy, _ = rotate_inverse(v.q, v.velocity[0] - surface[0], v.velocity[1] - surface[1], v.velocity[2] - surface[2])
    seen = m.flow_least <= distance <= m.flow_largest
    flow = (v.rates[0] + vy / distance, -v.rates[1] + vx / distance)  # FLU's y is FRD's -y
    for i in range(2):
        s.flow_rate[i] = flow[i] + m.flow_noise * noise[i] if seen else 0.0
    s.flow_gyro[0] = v.rates[0] + m.flow_gyro_noise * noise[2]
    s.flow_gyro[1] = -v.rates[1] + m.flow_gyro_noise * noise[3]
    s.flow_quality = _BEST_FLOW if seen else 0
    s.flow_fresh = 1


@kernel
def _surface_below(own, v, most, below):
    """Return the distance along the body's z axis, m, to the nearest surface, and its velocity, m/s, map.

    It is level ground at height 0, or any object within ``most`` except vehicle ``own`` itself.
    """
    still = (0.0, 0.0, 0.0)
    cosine = 1.0 - 2.0 * (v.q[1] * v.q[1] + v.q[2] * v.q[2])
    distance = max(v.position[2], 1e-3) / cosine if cosine > 0.1 else math.inf
    nodes, surfaces, things, places, numbers, velocities = below
    if places.shape[0] == 0:
        return distance, still
    limit = min(distance, most)
    x, y, z = rotate(v.q, 0.0, 0.0, -1.0)
    met, owner = distance_along(nodes, surfaces, things, places, numbers[own], v.position, (x, y, z), limit)
    if not met < limit:
        return distance, still
    if 0 <= owner < velocities.shape[0]:
        still = (velocities[owner, 0], velocities[owner, 1], velocities[owner, 2])
    return max(met, 1e-3), still


@kernel
def _look_down(own, s, v, m, noise, below):
    """Sample range finder and flow camera along the body's z axis."""
    distance, surface = _surface_below(own, v, max(m.range_largest, m.flow_largest), below)
    if m.range_fitted:
        _range_finder(s, m, noise, distance)
    if m.flow_fitted:
        _optical_flow(s, v, m, noise, distance, surface)


@kernel
def sample_vehicle(own, s, v, m, b, fast, slow, down, below, step, time_us, field, place, gravity, dt):
    """Fill the ``SENSORS`` record ``s`` of vehicle ``own``; see ``sample_all``. An absent one gets no samples."""
    if v.contact == ABSENT:
        return
    k = step % STEPS
    s.time_us = time_us
    s.mag_fresh = 0
    s.baro_fresh = 0
    s.gps_fresh = 0
    s.imu_missing = 0
    _imu(s, v, m, b, fast[k], gravity, dt)
    if k % MAG_EVERY:
        return
    noise = slow[k // MAG_EVERY]
    _walk_imu_biases(m, b, noise, dt * MAG_EVERY)
    _magnetometer(s, v, m, b, noise, field)
    if k % BARO_EVERY == 0:
        _barometer(s, v, m, b, noise, place[2], dt * BARO_EVERY)
    if k % GPS_EVERY == 0:
        _gps(s, v, m, b, noise, place[0], place[1], place[2], dt * GPS_EVERY)
    if k % FLOW_EVERY == 0 and (m.range_fitted or m.flow_fitted):
        _look_down(own, s, v, m, down[k // FLOW_EVERY], below)


@kernel
def sample_all(sensors, plant, models, bias, fast, slow, down, below, step, time_us, field, place, gravity, dt):
    """Fill every vehicle's ``SENSORS`` record for step number ``step``.

    Args:
        sensors, plant, models, bias: record arrays, shape (n,).
        fast: (n, STEPS, _FAST) standard normals of this block.
        slow: (n, STEPS // MAG_EVERY, _SLOW) likewise.
        down: (n, STEPS // FLOW_EVERY, _DOWN) likewise.
        below: see ``below.Below.arrays``.
        step: number of the step since the start.
        time_us: simulated time, microseconds.
        field: (3,) magnetic field, ENU, gauss.
        place: latitude, longitude (deg) and altitude (m AMSL) of the world's origin.
        gravity: m/s^2.
        dt: s.
    """
    for i in range(sensors.shape[0]):
        sample_vehicle(
            i, sensors[i], plant[i], models[i], bias[i], fast[i], slow[i], down[i], below,
            step, time_us, field, place, gravity, dt,
        )  # fmt: skip


class Sensors:
    """Sensors of all vehicles; writes the ``sensors`` records of the autopilots.

    Attributes:
        failing: failure injection for sensors and motors.
        noise: arguments ``bias``, ``fast``, ``slow`` and ``down`` of ``sample_all``.
        below: objects below the vehicles.
        place: argument ``place`` of ``sample_all``.
    """

    def __init__(
        self, world: World, others: Others, autopilot: Autopilot, seed: int, joins: Mapping[int, int] | None = None
    ) -> None:
        """Draw the turn-on biases.

        Args:
            world: provides the true state.
            others: vehicles and people that sensors can see.
            autopilot: its ``sensors`` are written.
            seed: seed of all noise; vehicle i uses its i-th child.
            joins: by index, the number of the join of each vehicle that has joined, from 1; see ``add_vehicle``.
        """
        count = len(world.plant)
        self._world, self._others = world, others
        self._autopilot = autopilot
        self._seed = seed
        self._streams: dict[int, np.random.Generator] = {}
        self._down_streams: dict[int, np.random.Generator] = {}
        self._bias = np.zeros(count, BIAS)
        for i in np.flatnonzero(world.plant["contact"] != ABSENT).tolist():
            self._begin(i, (joins or {}).get(i, 0))
        self._fast = np.empty((count, STEPS, _FAST), np.float32)
        self._slow = np.empty((count, STEPS // MAG_EVERY, _SLOW), np.float32)
        self._down = np.zeros((count, STEPS // FLOW_EVERY, _DOWN), np.float32)
        self.noise = self._bias, self._fast, self._slow, self._down
        self.below = Below(world, others, needed=bool(self._down_streams))
        self.failing = Failing(autopilot.failures, world.models, seed)
        datum = world.model.datum
        self.place = np.array([datum.latitude, datum.longitude, datum.altitude])

    def _begin(self, i: int, join: int) -> None:
        """Start the streams of vehicle ``i`` and draw its turn-on biases; see ``add_vehicle``."""
        keys = ((i,), (i, _DOWN_STREAM)) if not join else ((i, _JOINED, join, 0), (i, _JOINED, join, _DOWN_STREAM))
        stream, down = (
            np.random.Generator(np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=key))) for key in keys
        )
        self._streams[i] = stream
        m, b = self._world.models[i], self._bias[i]
        b["gyro"] = m["gyro_turn_on_bias"] * stream.standard_normal(3)
        b["accel"] = m["accel_turn_on_bias"] * stream.standard_normal(3)
        b["mag"] = m["mag_bias"] * stream.standard_normal(3)
        b["gps"] = m["gps_wander"] * stream.standard_normal(3)
        if m["flow_fitted"] or m["range_fitted"]:
            self._down_streams[i] = down

    def add_vehicle(self, i: int, join: int) -> None:
        """Start the noise of a vehicle that has joined.

        Args:
            i: its index.
            join: number of vehicles that have had this index since the start, from 1; the noise depends on it.
        """
        self._bias[i] = np.zeros(1, BIAS)[0]
        self._begin(i, join)
        self.failing.forget(i)
        self._draw(i)
        if i in self._down_streams and not self.below.needed:
            self.below = Below(self._world, self._others, needed=True)

    def remove_vehicle(self, i: int) -> None:
        """End the noise of a vehicle that leaves."""
        del self._streams[i]
        self._down_streams.pop(i, None)

    def draw(self, step: int) -> None:
        """Draw the noise of the next second if a block begins at step number ``step``."""
        if step % STEPS == 0:
            self.draw_block(0, len(self._bias))

    def draw_block(self, first: int, last: int) -> None:
        """Draw the noise of the next second of the vehicles ``first`` to ``last`` (excluded)."""
        for i in range(first, last):
            if i in self._streams:
                self._draw(i)

    def _draw(self, i: int) -> None:
        stream = self._streams[i]
        stream.standard_normal(dtype=np.float32, out=self._fast[i])
        stream.standard_normal(dtype=np.float32, out=self._slow[i])
        if i in self._down_streams:
            self._down_streams[i].standard_normal(dtype=np.float32, out=self._down[i])

    def sample(self, step: int, time_us: int) -> None:
        """Sample every sensor that is due at step number ``step``."""
        self.draw(step)
        if step % FLOW_EVERY == 0:
            self.below.update(time_us)
        world = self._world
        sample_all(
            self._autopilot.sensors,
            world.plant,
            world.models,
            *self.noise,
            self.below.arrays,
            step,
            time_us,
            world.magnetic_field,
            self.place,
            world.model.gravity,
            world.time_step,
        )
        was_failing = self.failing.any
        if self.failing.look() or was_failing:
            self.failing.sensors(self._autopilot.sensors)
