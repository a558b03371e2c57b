"""The mechanisation: against its readable twin, against coning motion, and against whole flights."""

import numpy as np
import pytest
from fleetalign.aircraft.cache import cached_flight
from fleetalign.aircraft.mission import Air, FlightPlan, Turbulence
from fleetalign.sins import attitude, earth, mechanization
from fleetalign.sins.earth import GravityModel
from fleetalign.sins.mechanization import NavigationState
from fleetalign.sins.units import ARCSEC


def replay_errors(flight, gravity):
    """Greatest attitude (rad), velocity (m/s) and position (m) error of a perfect IMU over a flight."""
    initial = NavigationState(flight.lla[0], flight.v_n[0], flight.q_nb[0])
    replay = mechanization.mechanize(flight.time, flight.dtheta_b, flight.dv_b, initial, gravity)
    return (
        np.abs(attitude.misalignment(replay.q_nb, flight.q_nb)).max(),
        np.abs(replay.v_n - flight.v_n).max(),
        np.abs(earth.displacement_n(replay.lla, flight.lla)).max(),
    )


def test_perfect_imu_replays_the_flight_in_calm_air(flight):
    attitude_error, v_error, position_error = replay_errors(flight, flight.gravity)
    assert attitude_error < 0.01 * ARCSEC
    assert v_error < 1e-3
    assert position_error < 0.1


def test_perfect_imu_replays_the_flight_in_moderate_turbulence(flight_cache):
    air = Air(turbulence=Turbulence.MILSPEC, turbulence_severity=4, turbulence_wind_mps=15.0)
    shaken, _ = cached_flight(FlightPlan(air=air, seed=3))
    attitude_error, _, position_error = replay_errors(shaken, shaken.gravity)
    assert attitude_error < 0.1 * ARCSEC
    assert position_error < 1.0
    # The air must really have shaken the aircraft.
    level = shaken.phase("level")
    assert np.std(shaken.window(level.start_s, level.end_s).load_factor) > 0.02


def test_navigating_with_another_gravity_model_than_was_flown_drifts(flight):
    attitude_error, v_error, position_error = replay_errors(flight, GravityModel.SOMIGLIANA)
    # 3 mGal for 545 s is 5 m, give and take the Schuler motion.
    assert 2.0 < position_error < 20.0
    assert v_error > 5e-3
    assert attitude_error > 0.01 * ARCSEC


@pytest.mark.parametrize("gravity", list(GravityModel))
def test_compiled_loop_is_the_readable_step(gravity):
    rng = np.random.default_rng(5)
    n, dt = 400, 0.01
    time = 7.0 + dt * np.arange(n)
    dtheta = rng.normal(0, 0.02, (n, 3))
    dtheta[100] = [0.3, -0.2, 0.25]  # beyond the series of the compiled sine
    dv = rng.normal(0, 0.3, (n, 3)) + [0, 0, -0.098]
    initial = NavigationState(
        np.array([0.5, 2.0, 1015.0]), np.array([140.0, -140.0, 5.0]), attitude.from_euler(0.3, -0.2, 2.0)
    )
    compiled = mechanization.mechanize(time, dtheta, dv, initial, gravity)
    state, before = initial, (np.zeros(3), np.zeros(3))
    for k in range(1, n):
        state = mechanization.step(state, dtheta[k], dv[k], *before, float(time[k] - time[k - 1]), gravity)
        before = dtheta[k], dv[k]
    np.testing.assert_allclose(compiled.lla[-1], state.lla, rtol=1e-13)
    np.testing.assert_allclose(compiled.v_n[-1], state.v_n, rtol=0, atol=1e-10)
    np.testing.assert_allclose(compiled.q_nb[-1], state.q_nb, rtol=0, atol=1e-13)


def test_coning_motion_does_not_drift():
    """Classical coning: the body's z axis goes round a cone at 2 Hz; the algorithm must follow it.

    The rate about z that makes the cone close is what an uncorrected sum of increments misses.
    """
    half_angle, w, dt, n = np.radians(1.0), 2 * np.pi * 2.0, 0.01, 6000
    time = dt * np.arange(n)

    def attitude_at(t):
        x = half_angle * np.stack([np.cos(w * t), np.sin(w * t), np.zeros_like(t)], axis=-1)
        return attitude.from_rotvec(x)

    # Body rate of q = exp(half_angle (cos wt, sin wt, 0)), integrated exactly over each interval.
    s, c = np.sin(half_angle), np.cos(half_angle)
    dtheta = np.zeros((n, 3))
    dtheta[1:, 0] = s * np.diff(np.cos(w * time))
    dtheta[1:, 1] = s * np.diff(np.sin(w * time))
    dtheta[1:, 2] = -(1 - c) * w * dt
    # At rest on the earth n turns at earth rate alone.
    lla, v_n = np.array([0.5, 0.0, 0.0]), np.zeros(3)
    w_in = np.array(earth.earth_rate_n(lla[0]))
    q_true = attitude.multiply(attitude.from_rotvec(-np.outer(time, w_in)), attitude_at(time))
    dv = np.zeros((n, 3))
    g_north, g_down = earth.gravity(GravityModel.J2, lla[0], 0.0)
    at_rest = -np.array([g_north, 0.0, g_down]) * dt
    dv[1:] = attitude.rotate(attitude.conjugate(0.5 * (q_true[1:] + q_true[:-1])), at_rest)
    initial = NavigationState(lla, v_n, q_true[0])
    with_correction = mechanization.mechanize(time, dtheta, dv, initial, GravityModel.J2)
    drift = np.abs(attitude.misalignment(with_correction.q_nb[-1], q_true[-1])).max()
    uncorrected = attitude_at(time[:1])[0]
    for k in range(1, n):
        uncorrected = attitude.multiply(uncorrected, attitude.from_rotvec(dtheta[k]))
    uncorrected_drift = np.abs(attitude.misalignment(uncorrected, attitude_at(time[-1:])[0])).max()
    assert uncorrected_drift > 20 * ARCSEC
    assert drift < 0.05 * uncorrected_drift
