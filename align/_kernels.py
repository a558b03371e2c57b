"""Compiled closed-loop error-state filter over one record of increments and fixes.

State vector ``X``, shape (22,): lla 0:3, v_n 3:6, q_nb 6:10, accelerometer bias 10:13, gyro bias
13:16, mean delay 16, lever arm 17:20, number of fixes refused in a row 20, time of the
last fix that was taken since the start 21. Error state, shape (n,), n = 16:
the fifteen of `sins.error_model` and the delay's error; n = 19 if the lever arm is estimated. The readable
twins of `kinematics` and `update` stand in `align.measurement` and `sins.gaussian`.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

from numba import njit

from ..sins._kernels import (
    COMPILED,
    advance,
    fill_C_nb,
    fill_transition,
    predict_covariance,
    rotate_attitude,
)
from ..sins.earth import EARTH_RATE, gravity, radii_of_curvature, transport_rate_n
from ._increments_kernel import add_held

N_STATES, N_X = 16, 22
"""States at least: those of the lever arm may follow."""
DELAY, LEVER = 15, 16
REFUSED, TAKEN_AT = 20, 21
IGNORED, STAMPED, ESTIMATED = 0, 1, 2
PENDING, FUSED, INITIALIZED, GATED, DUPLICATE, LATE, NOT_FINITE, FUTURE = range(8)


@njit(**COMPILED)
def predict(X, P, time, increments, gap_variance, k, noise_density, gravity_model, work):
    """Carry state and covariance from epoch k - 1 to epoch k.

    ``noise_density``, shape (n,), are the power spectral densities of the white noises on the states;
    ``gap_variance``, shape (n, 6), what missing samples add to the variances of the increments.
    """
    Phi, W, C, increment, previous, f_n, noise = work
    navigate(X, time, increments, k, gravity_model, increment, previous, f_n)
    fill_C_nb(X[6:10], C)
    fill_transition(X[0:3], X[3:6], f_n, C, time[k] - time[k - 1], Phi)
    fill_noise(time, k, noise_density, noise)
    predict_covariance(P, Phi, noise, W)
    if gap_variance[k].any():
        add_held(P, gap_variance, k, C)


@njit(**COMPILED)
def navigate(X, time, increments, k, gravity_model, increment, previous, f_n):
    """Carry the state from epoch k - 1 to epoch k, less its biases; ``f_n``, (3,), is written."""
    dt = time[k] - time[k - 1]
    for i in range(3):
        increment[i] = increments[k, i] - X[13 + i] * dt
        increment[3 + i] = increments[k, 3 + i] - X[10 + i] * dt
        previous[i] = increments[k - 1, i] - X[13 + i] * dt if k > 1 else 0.0
        previous[3 + i] = increments[k - 1, 3 + i] - X[10 + i] * dt if k > 1 else 0.0
    advance(X[0:3], X[3:6], X[6:10], increment, previous, dt, gravity_model, f_n)


@njit(**COMPILED)
def fill_noise(time, k, noise_density, noise):
    """Write the variances, (n,), that epoch k adds to the states."""
    for i in range(len(noise)):
        noise[i] = noise_density[i] * (time[k] - time[k - 1])


@njit(**COMPILED)
def kinematics(X, time, increments, k, samples, gravity_model, C, f_n, w_b, arm, u):
    """Velocity and acceleration of the antenna in n: ``u``, shape (6,).

    The specific force is averaged over the last ``samples`` intervals, so that vibration is not taken for
    acceleration. ``f_n`` (3,), ``C`` (C_nb), the rate ``w_b`` (3,) against n and ``arm`` (2, 3), the lever
    arm and its rate of change in n, are written too.
    """
    fill_C_nb(X[6:10], C)
    first = max(k - samples, 0)
    span = time[k] - time[first]
    lat, height = X[0], X[2]
    north, east, down = X[3], X[4], X[5]
    en_north, en_east, en_down = transport_rate_n(lat, height, north, east)
    in_north, in_down = EARTH_RATE * math.cos(lat) + en_north, -EARTH_RATE * math.sin(lat) + en_down
    for i in range(3):
        f_n[i] = 0.0
    for j in range(3):
        w_b[j] = 0.0
        if span > 0:
            mean = 0.0
            for s in range(first + 1, k + 1):
                mean += increments[s, 3 + j]
            # The rate of now: that of a window's middle would be late in every roll.
            turned = increments[k, j] if k == 1 else 1.5 * increments[k, j] - 0.5 * increments[k - 1, j]
            in_b = C[0, j] * in_north + C[1, j] * en_east + C[2, j] * in_down
            w_b[j] = turned / (time[k] - time[k - 1]) - X[13 + j] - in_b
            mean = mean / span - X[10 + j]
            for i in range(3):
                f_n[i] += C[i, j] * mean
    # Of the antenna about the IMU; what the angular acceleration adds is left out.
    lx, ly, lz = X[17], X[18], X[19]
    vx, vy, vz = w_b[1] * lz - w_b[2] * ly, w_b[2] * lx - w_b[0] * lz, w_b[0] * ly - w_b[1] * lx
    ax, ay, az = w_b[1] * vz - w_b[2] * vy, w_b[2] * vx - w_b[0] * vz, w_b[0] * vy - w_b[1] * vx
    for i in range(3):
        arm[0, i] = C[i, 0] * lx + C[i, 1] * ly + C[i, 2] * lz
        arm[1, i] = C[i, 0] * vx + C[i, 1] * vy + C[i, 2] * vz
    g_north, g_down = gravity(gravity_model, lat, height)
    c_north, c_east = 2 * EARTH_RATE * math.cos(lat) + en_north, en_east
    c_down = -2 * EARTH_RATE * math.sin(lat) + en_down
    u[0], u[1], u[2] = north, east, down
    u[3] = f_n[0] + g_north - (c_east * down - c_down * east)
    u[4] = f_n[1] - (c_down * north - c_north * down)
    u[5] = f_n[2] + g_down - (c_north * east - c_east * north)
    if span == 0:
        u[3] = u[4] = u[5] = 0.0
    for i in range(3):
        u[i] += arm[1, i]
        u[3 + i] += C[i, 0] * ax + C[i, 1] * ay + C[i, 2] * az


@njit(**COMPILED)
def update(
    X,
    P,
    lla,
    v_n,
    cov,
    vibration_variance,
    age,
    delay_sd,
    estimated,
    C,
    f_n,
    w_b,
    arm,
    u,
    gate,
    innovation,
    buffers,
):
    """Correct state and covariance by one fix; Joseph form. Returns (NIS, applied).

    Parameters: ``vibration_variance``, (m/s)^2, of the measured velocity about the mean motion; ``age``,
    s, how long before the present epoch the fix was valid; ``delay_sd``, s, its random part;
    ``estimated``, whether ``age`` holds the delay state; ``gate``, the largest NIS to accept.
    Nothing but ``innovation``, shape (6,), is written if the fix is not applied.
    """
    H, PHt, S, R, K, M, AP, x = buffers
    n_states = len(P)
    fill_innovation(X, lla, v_n, age, arm, u, innovation)
    for i in range(6):
        for j in range(n_states):
            H[i, j] = 0.0
    for i in range(3):
        H[i, i] = 1.0
        H[i, 3 + i] = -age
        H[3 + i, 3 + i] = 1.0
        for j in range(3):
            H[3 + i, 9 + j] = -age * C[i, j]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        H[i, 6 + j], H[j, 6 + i] = -arm[0, k], arm[0, k]
        H[3 + i, 6 + j] = age * f_n[k] - arm[1, k]
        H[3 + j, 6 + i] = -age * f_n[k] + arm[1, k]
        # An error of the rate swings the antenna; columns of C_nb (w x) and -C_nb (l x).
        for r in range(3):
            H[3 + r, 12 + k] = C[r, j] * X[17 + i] - C[r, i] * X[17 + j]
            if n_states > LEVER:
                H[r, LEVER + k] = C[r, k]
                H[3 + r, LEVER + k] = C[r, i] * w_b[j] - C[r, j] * w_b[i]
    if estimated:
        for i in range(6):
            H[i, DELAY] = -u[i]
    fill_fix_noise(cov, vibration_variance, delay_sd, u, R)
    for r in range(n_states):
        for i in range(6):
            s = 0.0
            for c in range(n_states):
                s += P[r, c] * H[i, c]
            PHt[r, i] = s
    for i in range(6):
        for j in range(i + 1):
            s = R[i, j]
            for c in range(n_states):
                s += H[i, c] * PHt[c, j]
            S[i, j] = s
    # Cholesky factor in the lower triangle of S.
    for i in range(6):
        for j in range(i + 1):
            s = S[i, j]
            for k in range(j):
                s -= S[i, k] * S[j, k]
            if i == j:
                if not s > 0:
                    return math.nan, False
                S[i, i] = math.sqrt(s)
            else:
                S[i, j] = s / S[j, j]
    nis = 0.0
    for i in range(6):
        s = innovation[i]
        for k in range(i):
            s -= S[i, k] * x[k]
        x[i] = s / S[i, i]
        nis += x[i] * x[i]
    if not nis <= gate:
        return nis, False

    for r in range(n_states):
        for i in range(6):
            s = PHt[r, i]
            for k in range(i):
                s -= S[i, k] * K[r, k]
            K[r, i] = s / S[i, i]
        for i in range(5, -1, -1):
            s = K[r, i]
            for k in range(i + 1, 6):
                s -= S[k, i] * K[r, k]
            K[r, i] = s / S[i, i]
    # Joseph form, (I - K H) P (I - K H)' + K R K', as AP - (AP H' - K R) K' with AP = P - K (P H')'.
    for r in range(n_states):
        for c in range(n_states):
            AP[r, c] = P[r, c]
        for i in range(6):
            k_ri = K[r, i]
            for c in range(n_states):
                AP[r, c] -= k_ri * PHt[c, i]
    for r in range(n_states):
        for i in range(6):
            s = 0.0
            for c in range(n_states):
                s += AP[r, c] * H[i, c]
            for j in range(6):
                s -= K[r, j] * R[j, i]
            M[r, i] = s
    for r in range(n_states):
        for c in range(r + 1):
            s = AP[r, c]
            for i in range(6):
                s -= M[r, i] * K[c, i]
            P[r, c] = s
            P[c, r] = s

    for r in range(n_states):
        s = 0.0
        for i in range(6):
            s += K[r, i] * innovation[i]
        x[r] = s
    correct(X, x)
    return nis, True


@njit(**COMPILED)
def fill_innovation(X, lla, v_n, age, arm, u, innovation):
    """Write the predicted less the measured fix, (6,), NED in m and m/s, which is ``age`` seconds old."""
    R_N, R_E = radii_of_curvature(X[0])
    innovation[0] = (X[0] - lla[0]) * (R_N + X[2]) + arm[0, 0] - age * u[0]
    east = X[1] - lla[1]
    east -= 2 * math.pi * round(east / (2 * math.pi))  # the date line may lie between
    innovation[1] = east * (R_E + X[2]) * math.cos(X[0]) + arm[0, 1] - age * u[1]
    innovation[2] = lla[2] - X[2] + arm[0, 2] - age * u[2]
    for i in range(3):
        innovation[3 + i] = X[3 + i] + arm[1, i] - age * u[3 + i] - v_n[i]


@njit(**COMPILED)
def fill_fix_noise(cov, vibration_variance, delay_sd, u, R):
    """Write the covariance, (6, 6), of a fix's errors: its own, vibration, and the random part of a delay."""
    for i in range(6):
        for j in range(6):
            R[i, j] = cov[i, j] + delay_sd * delay_sd * u[i] * u[j]
        if i >= 3:
            R[i, i] += vibration_variance


@njit(**COMPILED)
def correct(X, x):
    """Take an estimated error ``x``, shape (n,), from the state."""
    R_N, R_E = radii_of_curvature(X[0])
    X[0] -= x[0] / (R_N + X[2])
    X[1] -= x[1] / ((R_E + X[2]) * math.cos(X[0]))
    X[2] += x[2]
    for i in range(3):
        X[3 + i] -= x[3 + i]
        X[10 + i] += x[9 + i]
        X[13 + i] += x[12 + i]
    rotate_attitude(X[6:10], x[6], x[7], x[8])
    X[16] -= x[15]
    if len(x) > LEVER:
        for i in range(3):
            X[17 + i] -= x[LEVER + i]
