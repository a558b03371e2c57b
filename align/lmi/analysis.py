"""What a filter does in the closed loop, worked out without any solver of inequalities.

With eta = [xi; x^], q the random part of r, of variance s^2:

    eta(k+1) = (A0 + q A1) eta + (B0 + q B1) w,      e = (c0 + q c1) eta + (d0 + q d1) w

*Peak gain* (l2-linf): root of the largest E|e(k)|^2 over all w of unit energy; *energy gain* (H-infinity):
root of the largest sum of E|e|^2. A disturbance may be fixed in advance ("deterministic") or may answer to
the delays that it has seen ("adapted"), which is worse. For rho = 1 the two agree. The covariance of the
error under white noise is none of these for rho < 1.

Both gains come from a price lambda on the energy: with no more to win than lambda per unit, the value
function eta' Q eta of the game "error minus lambda times energy" stays finite, going back from the end.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import matrix_balance, solve_discrete_lyapunov
from scipy.optimize import minimize_scalar

from . import _game
from .plant import Array, Augmented, Filter, Plant
from .simulation import simulated_errors

TOLERANCE = 1e-5
"""Relative, of squares of gains; also the part of them that a recursion may leave out when it ends."""
ENERGY_TOLERANCE = 1e-3
"""The same for energy gains against adapted disturbances: near the gain their recursion hardly moves."""
MOST_STEPS = 50_000
FREQUENCIES = 2_000
SIMULATED = 2_000, 200
"""Runs and steps of the simulation."""


@dataclass(frozen=True)
class ClosedLoop:
    """Matrices of the closed loop; ``s``, deviation of q."""

    A0: Array
    A1: Array
    B0: Array
    B1: Array
    c0: Array
    c1: Array
    d0: Array
    d1: Array
    s: float

    @classmethod
    def of(cls, plant: Plant, filter_: Filter) -> "ClosedLoop":
        """The plant with the filter behind it."""
        a, f = Augmented.of(plant), filter_
        k, zeros = f.order, np.zeros
        A0 = np.block([[a.A, zeros((len(a.A), k))], [f.Bf @ a.C0, f.Af]])
        A1 = np.block([[zeros((len(a.A), len(a.A) + k))], [f.Bf @ a.C1, zeros((k, k))]])
        # Units in which equations for eta are well conditioned; nothing that is asked for depends on them.
        balanced, (unit, _) = matrix_balance(A0, permute=False, separate=True)
        return cls(
            A0=balanced,
            A1=A1 * unit / unit[:, None],
            B0=np.vstack([a.B, f.Bf @ a.D0]) / unit[:, None],
            B1=np.vstack([np.zeros_like(a.B), f.Bf @ a.D1]) / unit[:, None],
            c0=np.hstack([a.H - f.Df @ a.C0, -f.Cf]) * unit,
            c1=np.hstack([-f.Df @ a.C1, zeros((len(a.H), k))]) * unit,
            d0=-f.Df @ a.D0,
            d1=-f.Df @ a.D1,
            s=a.s,
        )

    @classmethod
    def fed_back(cls, plant: Plant, gain: Array) -> "ClosedLoop":
        """The plant with ``gain`` (n, m) times what is received taken out of its state; e = H x."""
        a = Augmented.of(plant)
        taken = -np.eye(len(a.A), len(gain)) @ gain
        balanced, (unit, _) = matrix_balance(a.A + taken @ a.C0, permute=False, separate=True)
        none = np.zeros((len(a.H), a.B.shape[1]))
        return cls(
            A0=balanced,
            A1=taken @ a.C1 * unit / unit[:, None],
            B0=(a.B + taken @ a.D0) / unit[:, None],
            B1=taken @ a.D1 / unit[:, None],
            c0=a.H * unit,
            c1=np.zeros_like(a.H),
            d0=none,
            d1=none,
            s=a.s,
        )

    @cached_property
    def _operator(self) -> Array:
        """X -> A0 X A0' + s^2 A1 X A1' on the upper triangles of symmetric matrices."""
        rows, columns = np.triu_indices(len(self.A0))
        whole = np.zeros((len(rows), len(rows)))
        for part in (self.A0, self.s * self.A1):
            direct = part[np.ix_(rows, rows)] * part[np.ix_(columns, columns)]
            crossed = part[np.ix_(rows, columns)] * part[np.ix_(columns, rows)]
            whole += np.where(rows == columns, direct, direct + crossed)
        return whole

    @cached_property
    def spectral_radius(self) -> float:
        """Of the operator X -> A0 X A0' + s^2 A1 X A1': mean-square stable if below 1."""
        return float(np.abs(np.linalg.eigvals(self._operator)).max())

    @cached_property
    def gramian(self) -> Array:
        """Stationary covariance of eta under white w of unit variance."""
        return self._stationary(self.B0 @ self.B0.T + self.s**2 * self.B1 @ self.B1.T, adjoint=False)

    @cached_property
    def observability(self) -> Array:
        """S: eta' S eta is what eta adds to the sum of E|e|^2 from now on, without further disturbances."""
        return self._stationary(self.c0.T @ self.c0 + self.s**2 * self.c1.T @ self.c1, adjoint=True)

    def _stationary(self, source: Array, adjoint: bool) -> Array:
        """Solution of X = operator (or its adjoint) of X, plus ``source``."""
        rows, columns = np.triu_indices(len(source))
        unit = np.where(rows == columns, 1.0, np.sqrt(2.0))  # in these the adjoint is the transpose
        operator = self._operator * unit[:, None] / unit
        left = np.eye(len(unit)) - (operator.T if adjoint else operator)
        X = np.zeros_like(source)
        X[rows, columns] = np.linalg.solve(left, unit * source[rows, columns]) / unit
        return X + np.triu(X, 1).T

    @property
    def error_covariance(self) -> Array:
        """Stationary covariance (p, p) of e under white w of unit variance."""
        return self.error_of(self.gramian)

    def error_of(self, P: Array) -> Array:
        """Covariance of e where that of eta is ``P``."""
        mean = self.c0 @ P @ self.c0.T + self.d0 @ self.d0.T
        return mean + self.s**2 * (self.c1 @ P @ self.c1.T + self.d1 @ self.d1.T)

    def carried(self, P: Array) -> Array:
        """Covariance of eta one step on, under white w of unit variance."""
        mean = self.A0 @ P @ self.A0.T + self.B0 @ self.B0.T
        return mean + self.s**2 * (self.A1 @ P @ self.A1.T + self.B1 @ self.B1.T)


def holds(loop: ClosedLoop, gain: float, adapted: bool, energy: bool, within: float = TOLERANCE) -> bool:
    """Whether no disturbance exceeds ``gain``: the energy gain, or the peak gain.

    A yes leaves out what can add no more than the part ``within`` to the square of the peak gain. A recursion
    that does not settle is a no.
    """
    if loop.spectral_radius >= 1:
        return False
    output = np.vstack([np.hstack([loop.c0, loop.d0]), loop.s * np.hstack([loop.c1, loop.d1])])
    return _game.settles(
        np.hstack([loop.A0, loop.B0]),
        loop.s * np.hstack([loop.A1, loop.B1]),
        output.T @ output,
        loop.gramian,
        float(gain**2),
        adapted,
        energy,
        TOLERANCE if energy else within,
        MOST_STEPS,
    )


def peak_gain(loop: ClosedLoop, adapted: bool) -> float:
    """The exact peak gain, against adapted or against deterministic disturbances."""
    if loop.spectral_radius >= 1:
        return np.inf
    # The mean error is G w with one matrix G: its covariance under white w is G G', its gain the norm of G.
    # What the random part adds can only raise it.
    P = solve_discrete_lyapunov(loop.A0, loop.B0 @ loop.B0.T)
    mean = float(np.linalg.eigvalsh(loop.c0 @ P @ loop.c0.T + loop.d0 @ loop.d0.T)[-1])
    if loop.s == 0 or mean <= 0:
        return float(np.sqrt(max(mean, 0.0)))
    fixed = _bisected(loop, False, False, mean, mean, TOLERANCE)
    return _bisected(loop, True, False, fixed**2, fixed**2, TOLERANCE) if adapted else fixed


def energy_gain(loop: ClosedLoop, adapted: bool) -> float:
    """The exact energy gain; against adapted disturbances to `ENERGY_TOLERANCE`, from above."""
    if loop.spectral_radius >= 1:
        return np.inf
    exact = _greatest_over_frequencies(loop)
    if loop.s == 0 or not adapted or exact == 0:
        return exact
    return _bisected(loop, True, True, exact**2, exact**2, ENERGY_TOLERANCE)


def _bisected(
    loop: ClosedLoop, adapted: bool, energy: bool, low: float, guess: float, tolerance: float
) -> float:
    """Least gain that `holds`, from above; its square is at least ``low``, and perhaps near ``guess``."""
    step = tolerance
    while not holds(loop, np.sqrt(guess * (1 + step)), adapted, energy, step / 4):
        low, step = guess * (1 + step), 8 * step
    high = guess * (1 + step)
    while high - low > tolerance * high:
        # What is left out may be of the size of the bracket: long recursions are for the last steps.
        middle, within = (low + high) / 2, (high - low) / high / 8
        if holds(loop, np.sqrt(middle), adapted, energy, within):
            high = middle * (1 + within)
        else:
            low = middle
    return float(np.sqrt(high))


def _greatest_over_frequencies(loop: ClosedLoop) -> float:
    """Energy gain against deterministic disturbances: the H-infinity norm of a system without q.

    The mean of eta is such a system. What q makes of the mean, ``A1 eta + B1 w``, is uncorrelated from step
    to step and costs ``observability`` each time: so it is an output beside the mean error.
    """
    values, vectors = np.linalg.eigh(loop.observability)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    C = np.vstack([loop.c0, loop.s * loop.c1, loop.s * root @ loop.A1])
    D = np.vstack([loop.d0, loop.s * loop.d1, loop.s * root @ loop.B1])

    def gains(frequency: Array) -> Array:
        shift = np.exp(1j * frequency)[:, None, None] * np.eye(len(loop.A0))
        transfer = C @ np.linalg.solve(shift - loop.A0, loop.B0.astype(complex)) + D
        return np.linalg.norm(transfer, 2, axis=(1, 2))

    modes = np.abs(np.angle(np.linalg.eigvals(loop.A0)))
    frequency = np.unique(np.concatenate([np.linspace(0, np.pi, FREQUENCIES), modes]))
    found = gains(frequency)
    best = int(found.argmax())
    nearby = frequency[max(best - 1, 0)], frequency[min(best + 1, len(frequency) - 1)]
    refined = minimize_scalar(lambda f: -gains(np.array([f]))[0], bounds=nearby, method="bounded")
    return float(max(found[best], -refined.fun))


@dataclass(frozen=True)
class Analysis:
    """What `analyze` finds, in units of z per unit of w; see the module for the names.

    Energy gains are None where nobody asked. ``simulated_rms`` is the RMS of a simulated error under white
    noise, ``simulated_sd`` its standard error, and ``expected_rms`` what the covariance recursion has for the
    same step.
    """

    spectral_radius: float
    peak_deterministic: float
    peak_adapted: float
    energy_deterministic: float | None
    energy_adapted: float | None
    white_rms: float
    simulated_rms: float
    simulated_sd: float
    expected_rms: float

    @property
    def simulation_agrees(self) -> bool:
        """Within six standard errors."""
        return abs(self.simulated_rms - self.expected_rms) <= 6 * self.simulated_sd


def analyze(plant: Plant, filter_: Filter, fed_back: bool = False, energy: bool = False) -> Analysis:
    """Stability, gains, white-noise RMS and a simulation of the closed loop.

    ``fed_back`` : the filter is the gain Bf alone, and what it makes of the output is taken out of the state.
    ``energy`` : whether to find the energy gains, which takes longest; they are None else.
    """
    loop = ClosedLoop.fed_back(plant, filter_.Bf) if fed_back else ClosedLoop.of(plant, filter_)
    if loop.spectral_radius >= 1:
        return Analysis(loop.spectral_radius, *[np.inf] * 5, *[np.nan] * 3)
    return Analysis(
        loop.spectral_radius,
        peak_gain(loop, adapted=False),
        peak_gain(loop, adapted=True),
        energy_gain(loop, adapted=False) if energy else None,
        energy_gain(loop, adapted=True) if energy else None,
        float(np.sqrt(np.trace(loop.error_covariance))),
        *_simulated_rms(plant, filter_, loop, fed_back),
    )


def _simulated_rms(
    plant: Plant, filter_: Filter, loop: ClosedLoop, fed_back: bool
) -> tuple[float, float, float]:
    """RMS of the simulated error, its standard error, and the RMS by the covariance of ``loop``."""
    runs, steps = SIMULATED
    square = (simulated_errors(plant, filter_, fed_back, runs, steps) ** 2).sum(axis=1)
    rms = float(np.sqrt(square.mean()))
    P = np.zeros_like(loop.A0)
    for _ in range(steps - 1):
        P = loop.carried(P)
    sd = float(square.std() / np.sqrt(runs) / (2 * rms)) if rms > 0 else 0.0
    return rms, sd, float(np.sqrt(np.trace(loop.error_of(P))))
