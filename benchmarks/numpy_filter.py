"""The alignment filter in readable numpy: the reference that the compiled one is timed against.

Built from the readable twins that the project's own tests hold the compiled steps to. For fixes that
are finite and arrive once each; duplicates are not looked for.
"""

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from fleetalign.align.measurement import N_STATES, Motion, kinematics, measure
from fleetalign.align.settings import DelayModel, FilterSettings, initial_sd, noise_density
from fleetalign.network.fixes import Fixes
from fleetalign.sins import attitude, earth
from fleetalign.sins.earth import GravityModel
from fleetalign.sins.error_model import (
    ACCEL,
    GYRO,
    MISALIGN,
    POSITION,
    VELOCITY,
    predict_covariance,
    transition_matrix,
)
from fleetalign.sins.gaussian import kalman_update
from fleetalign.sins.imu import ImuErrors
from fleetalign.sins.mechanization import NavigationState, step
from fleetalign.sins.units import MILLISECOND
from scipy.stats import chi2

Array = np.ndarray


@dataclass(frozen=True)
class Belief:
    """State of the filter at one epoch."""

    navigation: NavigationState
    accel_bias: Array
    gyro_bias: Array
    delay: float
    P: Array


@dataclass(frozen=True)
class NumpyFilter:
    """One record and what the filter is told; parameters as those of `AlignmentInput.checked`."""

    time: Array
    dtheta_b: Array
    dv_b: Array
    q_nb_coarse: Array
    fixes: Fixes
    settings: FilterSettings
    imu: ImuErrors
    gravity: GravityModel
    delay: DelayModel

    @cached_property
    def _noise_density(self) -> Array:
        return noise_density(self.imu)

    @cached_property
    def _gate(self) -> float:
        return float(chi2.ppf(self.settings.gate_probability, 6))

    def align(self) -> Belief:
        """State at the end of the record."""
        stamped = self.delay is DelayModel.STAMPED
        fixes = self.fixes.sorted_by_arrival()
        reference = fixes.t_stamp if stamped else fixes.t_arrival
        arrival = np.searchsorted(self.time, fixes.t_arrival)
        epochs = np.minimum(np.searchsorted(self.time, reference), arrival)
        # Applied in the order of their times where these are trusted.
        applied: list[tuple[int, float, int]] = []
        history: dict[int, Belief] = {}
        belief: Belief | None = None
        arriving = 0
        for k in range(len(self.time)):
            if belief is not None:
                belief = self._predicted(belief, k)
                history[k] = belief
            oldest = k + 1
            while arriving < len(fixes) and arrival[arriving] <= k:
                epoch = int(epochs[arriving]) if stamped else k
                applied.append((epoch, float(reference[arriving]), arriving))
                oldest = min(oldest, epoch)
                arriving += 1
            if oldest > k:
                continue
            applied.sort()
            if applied[0][0] == oldest:
                belief = self._started(fixes, applied[0][2], oldest)
            else:
                belief = history[oldest]
            for j in range(oldest, k + 1):
                if j > oldest:
                    belief = self._predicted(belief, j)
                    history[j] = belief
                here = applied[bisect_left(applied, (j,)) : bisect_left(applied, (j + 1,))]
                for fix in here:
                    belief = self._updated(belief, fixes, fix[2], j, reference, fix is applied[0])
        assert belief is not None, "no fix arrived"
        return belief

    def _started(self, fixes: Fixes, fix: int, epoch: int) -> Belief:
        lla, v_n, q_nb = fixes.lla[fix], fixes.v_n[fix], self.q_nb_coarse
        for j in range(1, epoch + 1):
            q_nb = self._step(NavigationState(lla, v_n, q_nb), j, np.zeros(3), np.zeros(3)).q_nb
        estimated = self.delay is DelayModel.ESTIMATED
        return Belief(
            NavigationState(lla, v_n, q_nb),
            np.zeros(3),
            np.zeros(3),
            self.settings.delay_mean_ms * MILLISECOND if estimated else 0.0,
            np.diag(initial_sd(self.settings, self.imu, self.delay) ** 2),
        )

    def _step(self, state: NavigationState, k: int, accel_bias: Array, gyro_bias: Array) -> NavigationState:
        dt = self.time[k] - self.time[k - 1]
        dtheta = self.dtheta_b[k - 1 : k + 1] - gyro_bias * dt
        dv = self.dv_b[k - 1 : k + 1] - accel_bias * dt
        previous = (dtheta[0], dv[0]) if k > 1 else (np.zeros(3), np.zeros(3))
        return step(state, dtheta[1], dv[1], *previous, dt, self.gravity)

    def _predicted(self, belief: Belief, k: int) -> Belief:
        dt = self.time[k] - self.time[k - 1]
        navigation = self._step(belief.navigation, k, belief.accel_bias, belief.gyro_bias)
        C_nb = attitude.to_dcm(navigation.q_nb)
        dtheta, dv = self.dtheta_b[k] - belief.gyro_bias * dt, self.dv_b[k] - belief.accel_bias * dt
        # The mean over the interval: in the axes at its end, the force has turned back by half.
        f_n = C_nb @ (dv - 0.5 * np.cross(dtheta, dv)) / dt
        Phi = np.eye(N_STATES)
        Phi[:15, :15] = transition_matrix(navigation.lla, navigation.v_n, f_n, C_nb, dt)
        P = predict_covariance(belief.P, Phi, self._noise_density * dt)
        return Belief(navigation, belief.accel_bias, belief.gyro_bias, belief.delay, P)

    def _updated(
        self, belief: Belief, fixes: Fixes, fix: int, k: int, reference: Array, first: bool
    ) -> Belief:
        navigation, dt = belief.navigation, self.time[1] - self.time[0]
        samples = max(1, round(self.settings.acceleration_window_s / dt))
        back = max(k - samples, 0)
        if k == back:
            still = np.zeros(3)
            motion = Motion(np.concatenate([navigation.v_n, still]), still, still, still)
        else:
            span = self.time[k] - self.time[back]
            f_b = self.dv_b[back + 1 : k + 1].sum(axis=0) / span - belief.accel_bias
            w_b = self.dtheta_b[k] / dt - belief.gyro_bias
            motion = kinematics(navigation, f_b, w_b, np.zeros(3), self.gravity)
        estimated = self.delay is DelayModel.ESTIMATED
        measurement = measure(
            navigation,
            fixes.lla[fix],
            fixes.v_n[fix],
            fixes.cov[fix],
            self.imu.vibration_mps**2,
            self.time[k] - reference[fix] + belief.delay,
            self.settings.delay_sd_ms * MILLISECOND if estimated else 0.0,
            estimated,
            motion,
        )
        n = len(belief.P)
        innovation, H, R = measurement
        x, P, _, S = kalman_update(np.zeros(n), belief.P, innovation, H[:, :n], R)
        if not first and innovation @ np.linalg.solve(S, innovation) > self._gate:
            return belief
        corrected = NavigationState(
            earth.displaced(navigation.lla, -x[POSITION]),
            navigation.v_n - x[VELOCITY],
            attitude.corrected(navigation.q_nb, x[MISALIGN]),
        )
        return Belief(
            corrected,
            belief.accel_bias + x[ACCEL],
            belief.gyro_bias + x[GYRO],
            belief.delay - x[15],
            (P + P.T) / 2,
        )
