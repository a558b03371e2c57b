"""The bound on misalignment along a bank profile, before anything has flown it.

A coordinated level turn at constant speed: heading rate ``g tan(bank) / V``, specific force ``-g`` down and
``g tan(bank)`` across the course, body axes rolled by the bank and turned by the heading. Along it runs the
covariance of the 15 error states of `sins.error_model` on a coarse grid: F is taken at a knot and holds from
half an interval before to half an interval after it, and the fixes of an interval are taken as one in its
middle; both are good to second order in the interval.

Two forms of the same recursion: `knot_covariances` reads (numpy, the whole of F), `bound_function` can be
differentiated (CasADi, without the turn of the earth and of the local level, 0.2 deg over 40 s).

References
----------
.. [1] P. Tichavsky, C. H. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time
       nonlinear filtering", IEEE Transactions on Signal Processing 46 (1998).
"""

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..sins import attitude
from ..sins.earth import STANDARD_GRAVITY as G
from ..sins.error_model import ACCEL, GYRO, MISALIGN, N_STATES, POSITION, VELOCITY, system_matrix
from ..sins.imu import ImuErrors
from .settings import DelayModel, FilterSettings, initial_sd, noise_density

Array = NDArray[np.float64]

_SCALE = np.repeat([1.0, 0.1, 1e-4, 1e-3, 1e-7], 3)
"""Units of the states in the recursion, in which their standard deviations are near one when aligned."""


@dataclass(frozen=True)
class AlignmentTask:
    """What is aligned, on what fixes, and where: the bound depends on this and the profile alone.

    ``speed_mps`` of the turn; ``heading`` rad at its start; ``latitude`` rad, ``altitude_m``; ``rate_hz`` of
    the fixes with standard deviations ``position_sd_m`` and ``velocity_sd_mps`` of each component.
    """

    settings: FilterSettings = field(default_factory=FilterSettings)
    imu: ImuErrors = field(default_factory=ImuErrors)
    rate_hz: float = 10.0
    position_sd_m: float = 10.0
    velocity_sd_mps: float = 0.1
    speed_mps: float = 200.0
    heading: float = 0.0
    latitude: float = 0.5
    altitude_m: float = 1015.0

    @property
    def fix_variance(self) -> Array:
        """Of one fix, (6,) m^2 and (m/s)^2; with the velocity's goes the vibration that the INS senses."""
        velocity = self.velocity_sd_mps**2 + self.imu.vibration_mps**2
        return np.repeat([self.position_sd_m**2, velocity], 3)

    @property
    def initial_variance(self) -> Array:
        """Of the 15 states after the first fix, which alone decides position and velocity."""
        variance = initial_sd(self.settings, self.imu, DelayModel.STAMPED)[:N_STATES] ** 2
        variance[:6] = self.fix_variance
        return variance

    @property
    def noise(self) -> Array:
        """Power spectral densities on the 15 states."""
        return noise_density(self.imu)[:N_STATES]


def knot_times(n: int, dt: float) -> Array:
    """Times of the knots of ``n`` intervals, (n + 1,) s."""
    return np.arange(n + 1, dtype=np.float64) * dt


def headings(bank: ArrayLike, dt: float, task: AlignmentTask) -> Array:
    """Heading at the knots, rad, (n + 1,), of banks (n + 1,) rad that are ``dt`` s apart."""
    rate = G * np.tan(np.asarray(bank, float)) / task.speed_mps
    return task.heading + np.concatenate([[0.0], np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))])


def knot_covariances(bank: ArrayLike, dt: float, task: AlignmentTask) -> Array:
    """Covariance of the misalignment at the knots, (n + 1, 3, 3) rad^2, along banks (n + 1,) rad.

    The fix at the start counts alone, those after it as one in the middle of each interval.
    """
    bank = np.asarray(bank, float)
    heading = headings(bank, dt, task)
    lla = np.array([task.latitude, 0.0, task.altitude_m])
    variance = task.fix_variance / (task.rate_hz * dt)
    P = np.diag(task.initial_variance)
    found = np.empty((len(bank), 3, 3))
    found[0] = P[MISALIGN, MISALIGN]
    for k, (roll, course) in enumerate(zip(bank, heading, strict=True)):
        along, across = (
            np.array([np.cos(course), np.sin(course), 0.0]),
            [-np.sin(course), np.cos(course), 0.0],
        )
        f_n = G * (np.tan(roll) * np.array(across) - [0.0, 0.0, 1.0])
        C_nb = attitude.to_dcm(attitude.from_euler(roll, 0.0, course))
        F = system_matrix(lla, task.speed_mps * along, f_n, C_nb)
        if k > 0:
            P = _fixed(P, variance)
            P = _moved(P, F, 0.5 * dt, task.noise)
            found[k] = P[MISALIGN, MISALIGN]
        if k < len(bank) - 1:
            P = _moved(P, F, 0.5 * dt, task.noise)
    return found


def _moved(P: Array, F: Array, dt: float, noise: Array) -> Array:
    Phi = np.eye(N_STATES) + F * dt + F @ F * (0.5 * dt**2)
    Q = np.diag(0.5 * dt * noise)
    return Phi @ (P + Q) @ Phi.T + Q


def _fixed(P: Array, variance: Array) -> Array:
    """After a fix of position and velocity, component by component."""
    for i, r in enumerate(variance):
        P = P - np.outer(P[i], P[i]) / (P[i, i] + r)
    return P


def bound_function(n: int, dt: float, task: AlignmentTask) -> Any:
    """CasADi function from banks (n + 1,) rad and headings (n + 1,) rad at the knots to two variances, rad^2.

    Those of level (mean of the two axes) and of heading at the last knot.
    """
    scale = _SCALE
    initial = ca.diag(task.initial_variance / scale**2)
    P, bank, heading = ca.SX.sym("P", N_STATES, N_STATES), ca.SX.sym("bank"), ca.SX.sym("heading")
    motion = ca.vertcat(bank, heading)
    half = ca.Function("half", [P, motion], [_symbolic_moved(P, bank, heading, 0.5 * dt, task)])
    fixed = _symbolic_fixed(P, task.fix_variance / scale[:6] ** 2 / (task.rate_hz * dt))
    step = ca.Function("step", [P, motion], [_symbolic_moved(fixed, bank, heading, dt, task)])
    last = ca.Function("last", [P, motion], [_symbolic_moved(fixed, bank, heading, 0.5 * dt, task)])

    banks, courses = ca.MX.sym("banks", n + 1), ca.MX.sym("headings", n + 1)
    motions = ca.horzcat(banks, courses).T
    P_0 = half(initial, motions[:, 0])
    P_n = step.fold(n - 1)(P_0, motions[:, 1:n])
    P_end = last(P_n, motions[:, n]) * scale[MISALIGN.start] ** 2
    i = MISALIGN.start
    level, course = 0.5 * (P_end[i, i] + P_end[i + 1, i + 1]), P_end[i + 2, i + 2]
    return ca.Function("bound", [banks, courses], [level, course])


def _symbolic_moved(P: Any, bank: Any, heading: Any, dt: float, task: AlignmentTask) -> Any:
    c, s = ca.cos(heading), ca.sin(heading)
    cr, sr = ca.cos(bank), ca.sin(bank)
    C_nb = ca.vertcat(ca.horzcat(c, -s * cr, s * sr), ca.horzcat(s, c * cr, -c * sr), ca.horzcat(0, sr, cr))
    f_n = G * ca.vertcat(-s * ca.tan(bank), c * ca.tan(bank), -1)
    F = ca.SX(N_STATES, N_STATES)
    F[POSITION, VELOCITY] = ca.SX.eye(3)
    F[VELOCITY, MISALIGN] = ca.skew(f_n)
    F[VELOCITY, ACCEL] = C_nb
    F[MISALIGN, GYRO] = -C_nb
    F = ca.mtimes([ca.diag(1 / _SCALE), F, ca.diag(_SCALE)])
    Phi = ca.sparsify(ca.SX.eye(N_STATES) + F * dt + ca.mtimes(F, F) * (0.5 * dt**2))
    Q = ca.diag(0.5 * dt * task.noise / _SCALE**2)
    return ca.mtimes([Phi, P + Q, Phi.T]) + Q


def _symbolic_fixed(P: Any, variance: Array) -> Any:
    for i, r in enumerate(variance):
        P = P - ca.mtimes(P[:, i], P[i, :]) / (P[i, i] + r)
    return P
