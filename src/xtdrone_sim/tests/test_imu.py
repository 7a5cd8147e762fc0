"""Further IMUs: lever arm and frame in closed form, noise, agreement with the plant, rejections."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.rotation_kernels import rotate_inverse
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.topics.imu_topics import Imu
from xtdrone_sim.vehicles.mounts.body_sensors import ImuMount, read_imus
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import MountError
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

STILL = np.zeros(3)
UP = np.array([0.0, 0.0, 9.80665])


def test_lever_arm_and_frame() -> None:
    """At 2 rad/s about z, growing by 3 rad/s^2, a sensor 0.5 m ahead measures -2 (centripetal) and 1.5 m/s^2."""
    rates, change = np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, 3.0])
    gyro, accel = Imu("iris_0", ImuMount(position=(0.5, 0.0, 0.0))).measure(0, rates, change, UP)
    assert gyro == pytest.approx([0.0, 0.0, 2.0])
    assert accel == pytest.approx([-2.0, 1.5, 9.80665])
    turned = ImuMount(position=(0.5, 0.0, 0.0), rpy=(0.0, 0.0, 0.5 * math.pi))  # its x axis is the body's y
    gyro, accel = Imu("iris_0", turned).measure(0, rates, change, UP)
    assert gyro == pytest.approx([0.0, 0.0, 2.0])
    assert accel == pytest.approx([1.5, 2.0, 9.80665])


def test_white_noise_has_its_density_and_repeats() -> None:
    mount = ImuMount(gyro_noise=0.002, accel_noise=0.05, rate=200.0, seed=4)
    imu = Imu("iris_0", mount)
    samples = [imu.measure(k * 5000, STILL, STILL, STILL) for k in range(3000)]
    gyro, accel = (np.array([sample[k] for sample in samples]) for k in (0, 1))
    assert gyro.std(axis=0) == pytest.approx(np.full(3, 0.002 * math.sqrt(200.0)), rel=0.05)
    assert accel.std(axis=0) == pytest.approx(np.full(3, 0.05 * math.sqrt(200.0)), rel=0.05)
    assert abs(np.corrcoef(gyro[:-1, 0], gyro[1:, 0])[0, 1]) < 0.06
    late = Imu("iris_0", mount).measure(2000 * 5000, STILL, STILL, STILL)  # without the samples before
    np.testing.assert_array_equal(late[0], gyro[2000])
    assert (Imu("iris_1", mount).measure(0, STILL, STILL, STILL)[0] != gyro[0]).all()


def test_bias_walks_with_the_square_root_of_time() -> None:
    spread = []
    for seed in range(60):
        imu = Imu("iris_0", ImuMount(accel_walk=0.01, gyro_bias=0.1, seed=seed))
        spread.append([imu.bias(time)[[0, 3]] for time in (0, 25_000_000, 100_000_000)])
    first, quarter, whole = np.array(spread).transpose(1, 2, 0).std(axis=2)
    assert first == pytest.approx([0.1, 0.0], abs=0.03)
    assert whole[0] == pytest.approx(first[0])  # a turn-on bias alone stays
    assert quarter[1] == pytest.approx(0.01 * 5.0, rel=0.3)
    assert whole[1] == pytest.approx(0.01 * 10.0, rel=0.3)


def test_a_perfect_imu_integrates_to_the_flight() -> None:
    """Specific force and attitude over a takeoff integrate to the plant's velocity."""
    simulation = Simulation(parse_fleet("iris:1"))
    simulation.run_until(2_000_000)
    commander = simulation.commanders[0]
    assert commander.request(modes.AUTO_TAKEOFF) == 0
    assert commander.arm_disarm(True) == 0
    simulation.run_until(4_000_000)
    imu = Imu("iris_0", ImuMount())
    v = simulation.world.plant[0]
    velocity = v["velocity"].copy()
    for _ in range(500):
        simulation.step()
        x, y, z = v["acceleration"].tolist()
        force = np.array(rotate_inverse(v["q"], x, y, z + 9.80665))
        _, accel = imu.measure(simulation.time_us, v["rates"], STILL, force)
        w, i, j, k = v["q"].tolist()
        velocity += 0.004 * (np.array(rotate_inverse(np.array([w, -i, -j, -k]), *accel)) - UP)
    assert velocity == pytest.approx(v["velocity"], abs=2e-3)
    simulation.close()


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({}, "imus: {} is not allowed, a list"),
        ([3], "imus, number 1: 3 is not allowed, a mapping"),
        ([{"rate": 500}], "imus, number 1 rate: 500.* is not allowed, 1 to 250 Hz"),
        ([{"noise": 1}], "imus, number 1: .* is not allowed, a mapping with name, frame_id"),
        ([{"name": "/imu"}], "name: '/imu' is not allowed"),
        ([{}, {}], "imus: name 'imu_gazebo' is given 2 times"),
    ],
)
def test_what_is_refused(entries: Any, words: str) -> None:
    if entries == {}:
        entries = {"name": "imu"}
        words = "imus: {'name': 'imu'} is not allowed, a list"
    with pytest.raises(MountError, match=words):
        read_imus(entries)


def test_upstream_s_models_have_theirs() -> None:
    for name in ("iris_stereo_camera", "iris_realsense_camera", "iris_3d_lidar", "iris_zhihang"):
        (imu,) = load_vehicle(name).imus
        assert (imu.name, imu.frame, imu.gyro_noise) == ("imu_gazebo", "imu_link_stereo", 0.0006)
    assert load_vehicle("iris").imus == ()
