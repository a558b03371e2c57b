"""The filters of the experiment of Xu et al. 2012, and the bound.

A filter corrects the INS at once (section 4), so that each has its own error; on one draw all see the same
noises. Gains depend on no data.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from ...align.lmi.stochastic_hinf import Form as When
from ...align.lmi.stochastic_hinf import NoisyPlant, design
from ...sins.gaussian import joseph, kalman_update, transposed
from .results import Array
from .xu2012_world import BIAS, SEEN, Draws, World, propagated


@dataclass(frozen=True)
class Gains:
    """A filter on the corrected INS: gains (n, 6, 4), zero without a fix.

    ``P`` (n, c, c): the covariance that it claims, of as many of the states as it has; None if it claims
    none. ``late``: it uses a fix from the next epoch on (2.9). ``anew``: it takes position and velocity from
    the first fix after an outage, and goes on from there. ``gamma``: what its energy gain keeps to.
    """

    K: Array
    P: Array | None = None
    late: bool = False
    anew: bool = True
    gamma: float = np.nan


def kalman(world: World, process_share: float = 1.0, with_bias: bool = False) -> Gains:
    """The Kalman filter on position and velocity, or on biases as well.

    With biases it is told the whole truth. Without, it is told ``process_share`` of `World.first_guess`.
    Both allow for the period's error by the covariance A_s P A_s' of what it multiplies.
    """
    n, states = len(world.time), 6 if with_bias else 4
    A, A_s = world.A[:, :states, :states], world.A_s[:, :states, :states]
    Q = np.diag(world.Q if with_bias else process_share * world.first_guess)
    H, cov = np.eye(4, states), np.diag(world.initial_variance[:states])
    K, claimed = np.zeros((n, 6, 4)), np.empty((n, states, states))
    zeros = np.zeros(states)
    for k in range(n):
        if k:
            cov = A[k - 1] @ cov @ A[k - 1].T + A_s[k - 1] @ cov @ A_s[k - 1].T + Q
        if k in world.returns and not with_bias:
            cov = world.R
        elif world.fixed[k]:
            updated = kalman_update(zeros, cov, np.zeros(4), H, world.R)
            K[k, :states], cov = updated.gain, updated.P
        claimed[k] = cov
    return Gains(K, claimed, anew=not with_bias)


def tuned_share(world: World) -> float:
    """Process noise of the KF without biases over `World.first_guess`, so that its errors are least.

    A lasting bias weighs more than white noise of its variance. By the true second moments of its errors in
    the first training area, each over the variance of a fix.
    """
    area = world.settings.stretches[0]

    def cost(decades: float) -> float:
        gains = kalman(world, 10**decades)
        moments = np.diagonal(second_moments(world, gains, area.stop), axis1=1, axis2=2)
        return float(np.mean(moments[:, SEEN] / np.diag(world.R)))

    found: Any = minimize_scalar(cost, bounds=(-1, 4), method="bounded", options={"xatol": 0.02})
    return 10 ** float(found.x)


def second_moments(world: World, gains: Gains, epochs: int) -> Array:
    """(epochs, 6, 6) true second moments of the errors with a filter that is not ``late``, up to the first
    return."""
    M, moments = np.diag(world.initial_variance), np.empty((epochs, 6, 6))
    H = np.eye(4, 6)
    for k in range(epochs):
        if k:
            A, A_s = world.A[k - 1], world.A_s[k - 1]
            M = A @ M @ A.T + A_s @ M @ A_s.T + np.diag(world.Q)
        if world.fixed[k]:
            M = joseph(M, gains.K[k], H, world.R)
        moments[k] = M
    return moments


def robust(world: World, when: When, process_share: float = 1.0, slack: float | None = None) -> Gains:
    """The stochastic H-infinity filter on position and velocity, with the weights that `kalman` is told.

    ``slack`` : of all gains with up to so many times the least gamma, one of little variance; None for least
    gamma.
    """
    design_of = plant(world, process_share)
    found = design(design_of, when)
    if slack is not None:
        found = design(design_of, when, slack * found.gamma)
    K = np.zeros((len(world.time), 6, 4))
    K[:, :4] = world.fixed[:, None, None] * found.K
    return Gains(K, late=when is When.PREDICTED, gamma=found.gamma)


def plant(world: World, process_share: float = 1.0) -> NoisyPlant:
    """(2.8) with noises of unit variance: B and D carry the standard deviations; all of the error counts."""
    B = np.hstack([np.diag(np.sqrt(process_share * world.first_guess))[:, 2:], np.zeros((4, 4))])
    D = np.hstack([np.zeros((4, 2)), np.sqrt(world.R)])
    return NoisyPlant(world.A[0, :4, :4], world.A_s[0, :4, :4], B, np.eye(4), D, np.eye(4))


def errors(world: World, draws: Draws, gains: Gains | None) -> Array:
    """(k, n, 6) errors of the INS with a filter, or of the INS alone."""
    e = draws.start
    history = np.empty((*draws.period.shape, 6))
    for k in range(len(world.time)):
        correction = 0.0
        if gains is not None and gains.anew and k in world.returns:
            e = np.concatenate([-draws.fix[:, k], e[:, BIAS]], axis=1)
        elif gains is not None and world.fixed[k]:
            correction = (e[:, SEEN] + draws.fix[:, k]) @ gains.K[k].T
            if not gains.late:
                e = e - correction
        history[:, k] = e
        e = propagated(world, draws, e, k)
        if gains is not None and gains.late:
            e = e - correction
    return history


def free_running(world: World, draws: Draws, corrected: Array) -> Array:
    """(k, n, 6) errors of an INS that is set to the ``corrected`` one at the start of each training area."""
    history = np.empty_like(corrected)
    starts = {area.start for area in world.settings.stretches[::2]}
    e = corrected[:, 0]
    for k in range(len(world.time)):
        if k in starts:
            e = np.concatenate([corrected[:, k, SEEN], e[:, BIAS]], axis=1)
        history[:, k] = e
        e = propagated(world, draws, e, k)
    return history


def bound(world: World, draws: Draws) -> Array:
    """(n, 4) Cramer-Rao bound of position and velocity, mean over the draws.

    Of one who is told the error of every period: then all is linear and Gaussian, and the Kalman filter's
    covariance is the bound. Who is not told it cannot do better.
    """
    n, count = len(world.time), len(draws.start)
    cov = np.broadcast_to(np.diag(world.initial_variance), (count, 6, 6))
    variances = np.empty((n, 4))
    H, zeros = np.eye(4, 6), np.zeros((count, 6))
    for k in range(n):
        if k:
            A = world.A[k - 1] + draws.period[:, k - 1, None, None] * world.A_s[k - 1]
            cov = A @ cov @ transposed(A) + np.diag(world.Q)
        if world.fixed[k]:
            cov = kalman_update(zeros, cov, np.zeros((count, 4)), H, world.R).P
        variances[k] = np.diagonal(cov, axis1=1, axis2=2).mean(axis=0)[SEEN]
    return variances
