"""Invariant Kalman filters in readable numpy: what the coarse stage is measured against.

They navigate in axes that do not turn, from an origin that moves uniformly: n at the first fix, held against
inertial space and carried along with the velocity of that fix. There ``C' = C [w x]``,
``v' = C f + gravitation`` and ``p' = v`` are affine on the group SE_2(3): the error e between two navigators
that are given the same increments follows one linear equation, however large it is. Two such errors are at
hand, of X = (C, v, p):

- right-invariant, ``X_computed = Exp(e) X``: its transition does not depend on the specific force. It is the
  error of the state-transformation filter, to first order ``dv - [v x] phi`` in the place of ``dv``.
- left-invariant, ``X_computed = X Exp(e)``: its transition depends on the increments alone, and a fix
  measures it without regard to where the navigator is.

The plain error, ``v_computed - v`` and ``p_computed - p``, is there for comparison. Errors are computed minus
true; that of attitude is the project's ``-phi``. That of a bias is what is left of it: true minus computed.

For fixes without delay that fall on samples of the IMU, the first of them on the first. Works on many runs at
once, which is why it is not slow.

References
----------
.. [1] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE Transactions
       on Automatic Control 62 (2017).
.. [2] M. Wang, W. Wu, P. Zhou, X. He, "State transformation extended Kalman filter for GPS/SINS tightly
       coupled integration", GPS Solutions 22 (2018).
"""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from fleetalign.align.settings import noise_density
from fleetalign.sins import attitude, error_model
from fleetalign.sins.attitude import skew
from fleetalign.sins.earth import GravityModel
from fleetalign.sins.imu import ImuErrors
from fleetalign.sins.units import DEG, DEG_PER_HOUR, MICRO_G
from scipy.spatial.transform import Rotation

from .inertial_frame import Array, Frame, apply

ATTITUDE, VELOCITY, POSITION, ACCEL, GYRO = (slice(k, k + 3) for k in range(0, 15, 3))
N_STATES = 15
ONE = np.eye(3)


class Error(Enum):
    """What a filter calls the error of its navigator."""

    PLAIN = "plain"
    RIGHT = "right-invariant"
    LEFT = "left-invariant"


class Records(NamedTuple):
    """What n runs were given, stacked; see `condensed`."""

    time: Array
    """(m,) s."""
    turn: Array
    """(n, m, 3, 3) C from b at the end of the interval that ends at ``time`` to b at its start."""
    dv: Array
    """(n, m, 3) integral of specific force over it, in b at its start."""
    q_nb: Array
    """(n, 4) attitude to start from, in n at the first fix."""
    epochs: Array
    """(k,) of the fixes."""
    lla: Array
    """(n, k, 3) of the fixes."""
    v_n: Array
    """(n, k, 3)."""
    cov: Array
    """(n, k, 6, 6) m and m/s, NED."""


class Aligned(NamedTuple):
    """What n runs made of them."""

    time: Array
    """(k,) of the fixes."""
    q_nb: Array
    """(n, k, 4) after each."""
    v_n: Array
    """(n, k, 3)."""
    misalignment_cov: Array
    """(n, k, 3, 3) as the filter has it, NED."""


def condensed(dtheta_b: Array, dv_b: Array, samples: int) -> tuple[Array, Array]:
    """``turn`` and ``dv`` of `Records` over so many samples each, from increments (n, m, 3)."""
    before = [np.roll(x, 1, axis=1) for x in (dtheta_b, dv_b)]
    rotvec = dtheta_b + np.cross(before[0], dtheta_b) / 12
    sculling = (np.cross(before[0], dv_b) + np.cross(before[1], dtheta_b)) / 12
    force = dv_b + 0.5 * np.cross(dtheta_b, dv_b) + sculling
    turn = attitude.to_dcm(attitude.from_rotvec(rotvec))
    n, m = force.shape[0], (force.shape[1] - 1) // samples
    turns, dv = np.tile(ONE, (n, m + 1, 1, 1)), np.zeros((n, m + 1, 3))
    for i in range(1, samples + 1):
        here = slice(i, i + (m - 1) * samples + 1, samples)
        dv[:, 1:] += apply(turns[:, 1:], force[:, here])
        turns[:, 1:] = turns[:, 1:] @ turn[:, here]
    return turns, dv


def exp(e: Array) -> tuple[Array, Array]:
    """Rotation of a rotation vector (n, 3), and the matrix that takes the rest of e on SE_2(3) along."""
    C = attitude.to_dcm(attitude.from_rotvec(e))
    angle = np.maximum(np.linalg.norm(e, axis=-1), 1e-4)[:, None, None]
    E = skew(e)
    return C, ONE + (1 - np.cos(angle)) / angle**2 * E + (angle - np.sin(angle)) / angle**3 * E @ E


@dataclass
class Belief:
    """State of the filter in n runs: X = (C, v, p), biases, covariance."""

    C: Array
    v: Array
    p: Array
    accel_bias: Array
    gyro_bias: Array
    P: Array


@dataclass(frozen=True)
class InvariantFilter:
    """What the filter is told besides its records."""

    error: Error
    level_sd_deg: float
    heading_sd_deg: float
    imu: ImuErrors
    gravity: GravityModel

    def align(self, records: Records) -> Aligned:
        """Attitude and velocity after each fix."""
        time, start = records.time, records.time[0]
        frame = Frame.at(records.lla[:, 0], records.v_n[:, 0])
        belief = self._started(records)
        C_nb, v_n, cov = [], [], []
        for j, epoch in enumerate(records.epochs):
            since = time[epoch] - start
            if j > 0:
                first = records.epochs[j - 1]
                # Gravitation is that of the middle of the time since the last fix.
                half = 0.5 * (time[epoch] - time[first])
                g = frame.gravitation(since - half, belief.p + half * belief.v, self.gravity)
                for k in range(first + 1, epoch + 1):
                    self.predict(belief, records.turn[:, k], records.dv[:, k], g, time[k] - time[k - 1])
                fix_v, fix_p, C_0n = frame.entered(since, records.lla[:, j], records.v_n[:, j])
                self._update(belief, fix_v, fix_p, self._noise(C_0n, records.cov[:, j]))
            _, v, C_0n = frame.left(since, belief.v, belief.p)
            C_n0 = C_0n.mT
            v_n.append(v)
            C_nb.append(C_n0 @ belief.C)
            to_n = C_n0 @ belief.C if self.error is Error.LEFT else C_n0
            cov.append(to_n @ belief.P[:, ATTITUDE, ATTITUDE] @ to_n.mT)
        rotations, v_n, cov = (np.array(x).swapaxes(0, 1) for x in (C_nb, v_n, cov))
        q_nb = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
        return Aligned(time[records.epochs], q_nb, v_n, cov)

    def _noise(self, C_0n: Array, cov: Array) -> Array:
        """(n, 6, 6) of velocity and position of a fix, in the frame."""
        C, R = np.zeros((len(cov), 6, 6)), np.zeros((len(cov), 6, 6))
        C[:, :3, 3:] = C[:, 3:, :3] = C_0n
        R[:, :3, :3] = self.imu.vibration_mps**2 * ONE
        return C @ cov @ C.mT + R

    def _started(self, records: Records) -> Belief:
        """At the first fix, which is the origin of the frame: there the errors of all kinds agree."""
        n = len(records.q_nb)
        C = attitude.to_dcm(records.q_nb)
        P = np.zeros((n, N_STATES, N_STATES))
        P[:, ATTITUDE, ATTITUDE] = np.diag([self.level_sd_deg, self.level_sd_deg, self.heading_sd_deg]) ** 2
        P[:, ATTITUDE, ATTITUDE] *= DEG**2
        P[:, 3:9, 3:9] = self._noise(np.tile(ONE, (n, 1, 1)), records.cov[:, 0])
        P[:, ACCEL, ACCEL] = (self.imu.accel_bias_ug * MICRO_G) ** 2 * ONE
        P[:, GYRO, GYRO] = (self.imu.gyro_bias_deg_h * DEG_PER_HOUR) ** 2 * ONE
        if self.error is Error.LEFT:
            for k in range(0, 9, 3):
                P[:, k : k + 3, k : k + 3] = C.mT @ P[:, k : k + 3, k : k + 3] @ C
        zero = np.zeros((n, 3))
        return Belief(C, zero, zero, zero, zero, P)

    def predict(self, belief: Belief, turn: Array, dv: Array, gravitation: Array, dt: float) -> Array:
        """Over one interval, navigator and covariance; returns the transition of the error (n, 15, 15)."""
        turn = turn @ (ONE - skew(belief.gyro_bias * dt))
        dv = dv - belief.accel_bias * dt
        C, v, p = belief.C, belief.v, belief.p
        belief.C = C @ turn
        belief.v = v + apply(C, dv) + gravitation * dt
        belief.p = p + 0.5 * (v + belief.v) * dt

        # What the sensors' errors do: a rate to attitude, a force to velocity.
        n = len(C)
        B, A = np.zeros((n, 9, 6)), np.zeros((n, N_STATES, N_STATES))
        A[:, POSITION, VELOCITY] = ONE
        if self.error is Error.LEFT:
            A[:, VELOCITY, ATTITUDE] = -skew(dv / dt)
            B[:, ATTITUDE, 3:] = B[:, VELOCITY, :3] = ONE
        else:
            B[:, ATTITUDE, 3:] = B[:, VELOCITY, :3] = C_mean = 0.5 * (C + belief.C)
            if self.error is Error.PLAIN:
                A[:, VELOCITY, ATTITUDE] = -skew(apply(C, dv / dt))
            else:
                A[:, VELOCITY, ATTITUDE] = skew(gravitation)
                B[:, VELOCITY, 3:] = skew(0.5 * (v + belief.v)) @ C_mean
                B[:, POSITION, 3:] = skew(0.5 * (p + belief.p)) @ C_mean
        A[:, :9, 9:] = B
        A *= dt
        Phi = np.eye(N_STATES) + A + 0.5 * A @ A
        noise = (B * self._density * dt) @ B.mT
        if self.error is Error.LEFT:
            # The error is told in b, and b turns.
            for part in (ATTITUDE, VELOCITY, POSITION):
                Phi[:, part] = turn.mT @ Phi[:, part]
        belief.P = Phi @ belief.P @ Phi.mT
        belief.P[:, :9, :9] += noise
        return Phi

    @cached_property
    def _density(self) -> Array:
        """(6,) of the white noises of accelerometers and gyros, which are alike on all axes."""
        density = noise_density(self.imu)
        return np.concatenate([density[error_model.VELOCITY], density[error_model.MISALIGN]])

    def _update(self, belief: Belief, fix_v: Array, fix_p: Array, R: Array) -> None:
        C, v, p, P = belief.C, belief.v, belief.p, belief.P
        z = np.concatenate([v - fix_v, p - fix_p], axis=1)[..., None]
        H = np.zeros((len(C), 6, N_STATES))
        H[:, :3, VELOCITY] = H[:, 3:, POSITION] = ONE
        if self.error is Error.RIGHT:
            H[:, :3, ATTITUDE], H[:, 3:, ATTITUDE] = -skew(v), -skew(p)
        elif self.error is Error.LEFT:
            H[:, :3, VELOCITY] = H[:, 3:, POSITION] = C
        S = H @ P @ H.mT + R
        K = np.linalg.solve(S, H @ P).mT
        I_KH = np.eye(N_STATES) - K @ H
        belief.P = I_KH @ P @ I_KH.mT + K @ R @ K.mT
        x = -(K @ z)[..., 0]
        turn, J = exp(x[:, ATTITUDE])
        dv, dp = x[:, VELOCITY], x[:, POSITION]
        belief.C = C @ turn if self.error is Error.LEFT else turn @ C
        if self.error is Error.LEFT:
            dv, dp = apply(C @ J, dv), apply(C @ J, dp)
        elif self.error is Error.RIGHT:
            v, p, dv, dp = apply(turn, v), apply(turn, p), apply(J, dv), apply(J, dp)
        belief.v, belief.p = v + dv, p + dp
        # Of a bias the error is what is left of it, not what is too much.
        belief.accel_bias = belief.accel_bias - x[:, ACCEL]
        belief.gyro_bias = belief.gyro_bias - x[:, GYRO]
