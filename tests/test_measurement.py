"""A late fix as a measurement, from first principles: H by differences, R by sampling, u from the truth."""

import numpy as np
import pytest
from fleetalign.align import measurement
from fleetalign.align.settings import DelayModel, FilterSettings, initial_sd, noise_density
from fleetalign.sins import attitude, earth
from fleetalign.sins.error_model import ACCEL, GYRO, MISALIGN, POSITION, VELOCITY
from fleetalign.sins.imu import ImuErrors
from fleetalign.sins.mechanization import NavigationState
from fleetalign.sins.units import DEG_PER_HOUR, MICRO_G

STATE = NavigationState(
    np.array([0.52, 2.1, 1010.0]), np.array([140.0, 141.0, 2.0]), attitude.from_euler(0.5, 0.05, 0.8)
)
F_B = np.array([1.0, 0.7, -11.3])
W_B = np.array([0.4, 0.1, -0.2])
ARM = np.array([3.0, -1.0, -2.0])
FIX = earth.displaced(STATE.lla, [8.0, -5.0, 3.0]), STATE.v_n + np.array([0.1, -0.2, 0.05])
COV = np.diag([100.0] * 3 + [0.01] * 3)


def innovation(error, age, arm):
    """Innovation when the navigator's state has this error; biases act through ``F_B`` and ``W_B``."""
    state = NavigationState(
        earth.displaced(STATE.lla, error[POSITION]),
        STATE.v_n + error[VELOCITY],
        attitude.multiply(attitude.from_rotvec(-error[MISALIGN]), STATE.q_nb),
    )
    motion = measurement.kinematics(
        state, F_B + error[ACCEL], W_B + error[GYRO], arm + error[measurement.LEVER], earth.GravityModel.J2
    )
    age = age + error[measurement.DELAY]
    return measurement.measure(state, *FIX, COV, 0.0, age, 0.0, True, motion).innovation


def motion_now(arm=ARM):
    return measurement.kinematics(STATE, F_B, W_B, arm, earth.GravityModel.J2)


@pytest.mark.parametrize(("age", "arm"), [(0.0, ARM), (0.034, 0 * ARM), (0.5, 0 * ARM)])
def test_measurement_matrix_is_the_derivative_of_the_innovation(age, arm):
    H = measurement.measure(STATE, *FIX, COV, 0.0, age, 0.0, True, motion_now(arm)).H
    steps = np.repeat([1.0, 0.1, 1e-4, 1e-3, 1e-6, 1e-3, 1e-2], [3, 3, 3, 3, 3, 1, 3])
    numeric = np.stack(
        [
            (innovation(step * axis, age, arm) - innovation(-step * axis, age, arm)) / (2 * step)
            for step, axis in zip(steps, np.eye(19), strict=True)
        ],
        axis=1,
    )
    # Neglected: the change of the Coriolis acceleration and of the metres per radian; that the rate of n,
    # some 1e-4 rad/s, is told in computed axes; and that what the arm does is late as well.
    columns = slice(None) if age == 0 else slice(measurement.N_STATES)
    atol = 1e-4 * (1 + 10 * age + np.abs(arm).max())
    np.testing.assert_allclose(numeric[:, columns], H[:, columns], atol=atol)
    if age:
        assert np.abs(H[3:, MISALIGN]).max() > 5 * age
        assert np.abs(H[3:, ACCEL]).max() > 0.5 * age


def test_delay_is_no_state_unless_estimated():
    assert not measurement.measure(STATE, *FIX, COV, 0.0, 0.03, 0.0, False, motion_now()).H[:, 15].any()


def test_noise_covariance_is_that_of_sampled_delays_and_vibration():
    delay_sd, vibration, n = 0.0144, 0.05, 200_000
    R = measurement.measure(STATE, *FIX, COV, vibration**2, 0.025, delay_sd, True, motion_now()).R
    rng = np.random.default_rng(9)
    late = np.outer(rng.normal(0, delay_sd, n), motion_now().u)
    samples = rng.normal(size=(n, 6)) * np.sqrt(np.diag(COV)) + late
    samples[:, 3:] += rng.normal(0, vibration, (n, 3))
    scale = np.sqrt(np.diag(R))
    deviation = (np.cov(samples.T) - R) / np.outer(scale, scale)
    assert np.abs(deviation).max() < 5 * np.sqrt(2 / n)


def test_kinematics_are_the_motion_of_the_flight(window):
    """Velocity's derivative from specific force, against differences of the true velocity."""
    k, dt = 700, window.dt
    state = NavigationState(window.lla[k], window.v_n[k], window.q_nb[k])
    f_b = window.dv_b[k - 1 : k + 3].mean(axis=0) / dt
    u = measurement.kinematics(state, f_b, np.zeros(3), np.zeros(3), window.gravity).u
    a_n = (window.v_n[k + 2] - window.v_n[k - 2]) / (4 * dt)
    # 2 w x v is 0.03 m/s^2 here.
    np.testing.assert_allclose(u[3:], a_n, atol=4e-3)
    np.testing.assert_array_equal(u[:3], window.v_n[k])


def test_antenna_moves_as_its_positions_do(window):
    """Velocity and centripetal acceleration of the antenna, against differences of its true positions."""
    k, dt = 700, window.dt
    state = NavigationState(window.lla[k], window.v_n[k], window.q_nb[k])
    rows = slice(k - 1, k + 3)
    f_b, w_b = window.dv_b[rows].mean(axis=0) / dt, window.dtheta_b[rows].mean(axis=0) / dt
    motion = measurement.kinematics(state, f_b, w_b, ARM, window.gravity)
    swing = (attitude.rotate(window.q_nb[k + 1], ARM) - attitude.rotate(window.q_nb[k - 1], ARM)) / (2 * dt)
    assert np.linalg.norm(swing) > 0.1
    np.testing.assert_allclose(motion.u[:3], window.v_n[k] + swing, atol=5e-3)
    still = measurement.kinematics(state, f_b, w_b, np.zeros(3), window.gravity)
    turned = attitude.rotate(window.q_nb[k], np.cross(motion.w_b, np.cross(motion.w_b, ARM)))
    np.testing.assert_allclose(motion.u[3:] - still.u[3:], turned, atol=1e-12)


def test_filter_is_told_the_error_budget_in_si():
    errors = ImuErrors(
        gyro_bias_instability_deg_h=0.01, accel_bias_instability_ug=50.0, accel_bias_correlation_s=300.0
    )
    sd = initial_sd(FilterSettings(), errors, DelayModel.ESTIMATED)
    np.testing.assert_allclose(sd[MISALIGN], np.radians([1, 1, 10]))
    np.testing.assert_allclose(sd[ACCEL], np.hypot(100, 50) * MICRO_G)
    np.testing.assert_allclose(sd[GYRO], np.hypot(0.02, 0.01) * DEG_PER_HOUR)
    assert sd[15] == pytest.approx(0.03)
    assert initial_sd(FilterSettings(), errors, DelayModel.STAMPED)[15] == 0
    density = noise_density(errors)
    np.testing.assert_allclose(np.sqrt(density[MISALIGN]), np.radians(0.01) / 60)
    np.testing.assert_allclose(np.sqrt(density[VELOCITY]), 5e-6 * 9.80665)
    np.testing.assert_allclose(density[GYRO], 2 * (0.01 * DEG_PER_HOUR) ** 2 / 600)
    np.testing.assert_allclose(density[ACCEL], 2 * (50 * MICRO_G) ** 2 / 300)
