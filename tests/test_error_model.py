"""Error-state dynamics: against CasADi's derivatives of the nonlinear model, and twins of the kernels."""

import casadi as ca
import numpy as np
import pytest
from fleetalign.sins import _kernels, attitude, earth, error_model, mechanization
from fleetalign.sins.error_model import ACCEL, GYRO, MISALIGN, POSITION, VELOCITY
from fleetalign.sins.mechanization import NavigationState

LLA = np.array([0.55, 2.1, 1015.0])
V_N = np.array([150.0, -130.0, 4.0])
Q_NB = attitude.from_euler(0.5, 0.1, -0.7)
F_B = np.array([1.0, -0.5, -11.0])
W_IB_B = np.array([0.1, 0.05, -0.2])


def skew(v):
    return ca.vertcat(ca.horzcat(0, -v[2], v[1]), ca.horzcat(v[2], 0, -v[0]), ca.horzcat(-v[1], v[0], 0))


def radii(lat):
    x = 1 - earth.ECCENTRICITY_SQUARED * ca.sin(lat) ** 2
    R_E = earth.EQUATORIAL_RADIUS / ca.sqrt(x)
    return R_E * (1 - earth.ECCENTRICITY_SQUARED) / x, R_E


def rates(lla, v):
    """w_ie and w_en in n, written anew from Groves (2.123) and (5.44)."""
    R_N, R_E = radii(lla[0])
    w_ie = earth.EARTH_RATE * ca.vertcat(ca.cos(lla[0]), 0, -ca.sin(lla[0]))
    w_en = ca.vertcat(v[1] / (R_E + lla[2]), -v[0] / (R_N + lla[2]), -v[1] * ca.tan(lla[0]) / (R_E + lla[2]))
    return w_ie, w_en


def gravity(lla):
    """Gradient of the potential of point mass, J2 and centrifugal force, in n."""
    lat, height = ca.SX.sym("lat"), ca.SX.sym("height")
    _, R_E = radii(lat)
    x, z = (R_E + height) * ca.cos(lat), (R_E * (1 - earth.ECCENTRICITY_SQUARED) + height) * ca.sin(lat)
    r, a = ca.sqrt(x**2 + z**2), earth.EQUATORIAL_RADIUS
    legendre = (3 * (z / r) ** 2 - 1) / 2
    potential = (
        earth.GRAVITATIONAL_PARAMETER / r * (1 - earth.J2 * (a / r) ** 2 * legendre)
        + 0.5 * earth.EARTH_RATE**2 * x**2
    )
    R_N, _ = radii(lat)
    north = ca.gradient(potential, lat) / (R_N + height)
    down = -ca.gradient(potential, height)
    return ca.substitute(ca.vertcat(north, 0, down), ca.vertcat(lat, height), ca.vertcat(lla[0], lla[2]))


def navigation_rates(lla, v, C, f_b):
    R_N, R_E = radii(lla[0])
    w_ie, w_en = rates(lla, v)
    lla_rate = ca.vertcat(v[0] / (R_N + lla[2]), v[1] / ((R_E + lla[2]) * ca.cos(lla[0])), -v[2])
    v_rate = C @ f_b + gravity(lla) - ca.cross(2 * w_ie + w_en, v)
    return lla_rate, v_rate


def casadi_system_matrix():
    """d(error rate) / d(error) at zero error: the computed navigation against the true one."""
    x = ca.SX.sym("x", 15)
    dp, dv, phi, ba, bg = (x[k : k + 3] for k in range(0, 15, 3))
    lla, v, C = ca.SX(LLA), ca.SX(V_N), ca.SX(attitude.to_dcm(Q_NB))
    R_N, R_E = radii(lla[0])
    scale = ca.vertcat(R_N + lla[2], (R_E + lla[2]) * ca.cos(lla[0]), -1)
    lla_hat, v_hat, C_hat = lla + dp / scale, v + dv, (ca.SX.eye(3) - skew(phi)) @ C

    lla_rate, v_rate = navigation_rates(lla, v, C, ca.SX(F_B))
    lla_rate_hat, v_rate_hat = navigation_rates(lla_hat, v_hat, C_hat, ca.SX(F_B) + ba)
    # The metres per radian change as the vehicle moves.
    symbol = ca.SX.sym("lla", 3)
    R_N_s, R_E_s = radii(symbol[0])
    scale_s = ca.vertcat(R_N_s + symbol[2], (R_E_s + symbol[2]) * ca.cos(symbol[0]), -1)
    scale_rate = ca.substitute(ca.jacobian(scale_s, symbol) @ lla_rate, symbol, lla)
    dp_rate = scale_rate * dp / scale + scale * (lla_rate_hat - lla_rate)

    w_in, w_in_hat = (sum(rates(*arguments)) for arguments in ((lla, v), (lla_hat, v_hat)))
    C_rate = C @ skew(ca.SX(W_IB_B)) - skew(w_in) @ C
    C_rate_hat = C_hat @ skew(ca.SX(W_IB_B) + bg) - skew(w_in_hat) @ C_hat
    turn = C_rate_hat @ C.T + C_hat @ C_rate.T
    phi_rate = -ca.vertcat(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2

    rate = ca.vertcat(dp_rate, v_rate_hat - v_rate, phi_rate, ca.SX.zeros(6))
    return np.array(ca.Function("F", [x], [ca.jacobian(rate, x)])(np.zeros(15)))


def test_system_matrix_is_the_derivative_of_the_nonlinear_model():
    C_nb = attitude.to_dcm(Q_NB)
    ours = error_model.system_matrix(LLA, V_N, C_nb @ F_B, C_nb)
    exact = casadi_system_matrix()
    # Neglected: change of radii and gravity with latitude. Everything else to rounding.
    np.testing.assert_allclose(ours[:, 9:], exact[:, 9:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours[:, MISALIGN], exact[:, MISALIGN], rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours[:, VELOCITY], exact[:, VELOCITY], rtol=0, atol=1e-15)
    assert np.abs(ours - exact).max() < 1e-7
    for row, scale in ((POSITION, 1e-5), (VELOCITY, 1e-6), (MISALIGN, 1e-12)):
        block = exact[row, POSITION]
        assert np.abs(block).max() > scale
        assert np.abs(ours[row, POSITION] - block).max() < 0.01 * np.abs(block).max()


def test_error_model_predicts_the_drift_of_the_mechanisation(window):
    """Small errors, put into the mechanisation, grow as the transition matrices say."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=15) * np.repeat([1.0, 0.01, 1e-5, 1e-4, 1e-8], 3)
    n = 1001
    time, dt = window.time[:n], window.dt
    dtheta, dv = window.dtheta_b[:n], window.dv_b[:n]
    wrong = NavigationState(
        earth.displaced(window.lla[0], x[POSITION]),
        window.v_n[0] + x[VELOCITY],
        attitude.multiply(attitude.from_rotvec(-x[MISALIGN]), window.q_nb[0]),
    )
    right = NavigationState(window.lla[0], window.v_n[0], window.q_nb[0])
    exact = mechanization.mechanize(time, dtheta, dv, right, window.gravity)
    drifted = mechanization.mechanize(time, dtheta + x[GYRO] * dt, dv + x[ACCEL] * dt, wrong, window.gravity)
    start = x.copy()
    for k in range(1, n):
        C_nb = attitude.to_dcm(window.q_nb[k])
        f_n = attitude.to_dcm(window.q_nb[k - 1]) @ dv[k] / dt
        x = error_model.transition_matrix(window.lla[k], window.v_n[k], f_n, C_nb, dt) @ x
    grown = np.abs(x - start)[:9].reshape(3, 3).max(axis=1)
    actual = np.concatenate(
        [
            earth.displacement_n(drifted.lla[-1], exact.lla[-1]),
            drifted.v_n[-1] - exact.v_n[-1],
            attitude.misalignment(drifted.q_nb[-1], exact.q_nb[-1]),
        ]
    )
    deviation = np.abs(x[:9] - actual).reshape(3, 3).max(axis=1)
    assert (deviation < 0.01 * grown).all(), (deviation, grown)


@pytest.mark.parametrize("v_n", [V_N, np.zeros(3)])
def test_compiled_transition_is_the_readable_one(v_n):
    C_nb = attitude.to_dcm(Q_NB)
    Phi = np.zeros((9, 15))
    _kernels.fill_transition(LLA, v_n, C_nb @ F_B, C_nb, 0.01, Phi)
    readable = error_model.transition_matrix(LLA, v_n, C_nb @ F_B, C_nb, 0.01)
    np.testing.assert_allclose(Phi, readable[:9], rtol=1e-13, atol=1e-18)


def test_compiled_covariance_prediction_is_the_readable_one():
    rng = np.random.default_rng(2)
    C_nb = attitude.to_dcm(Q_NB)
    readable = np.eye(16)
    readable[:15, :15] = error_model.transition_matrix(LLA, V_N, C_nb @ F_B, C_nb, 0.01)
    root, noise = rng.normal(size=(16, 16)), rng.random(16)
    P = root @ root.T
    expected = error_model.predict_covariance(P, readable, noise)
    _kernels.predict_covariance(P, np.ascontiguousarray(readable[:9, :15]), noise, np.empty((9, 16)))
    np.testing.assert_allclose(P, expected, rtol=1e-12, atol=1e-12)
    assert (P == P.T).all()


def test_attitude_error_matrix_is_the_derivative_of_the_euler_errors():
    T = attitude.attitude_error_matrix(Q_NB)
    for axis in np.eye(3):
        turned = attitude.multiply(attitude.from_rotvec(-1e-6 * axis), Q_NB)
        np.testing.assert_allclose(T @ axis, attitude.attitude_error(turned, Q_NB) / 1e-6, atol=1e-5)
