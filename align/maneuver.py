"""The best manoeuvre: the bank profile whose bound on misalignment is least at its end.

Unknowns are the banks at knots, straight lines between them. Minimised is

    J = P_north + P_east + heading_weight * P_down

of the misalignment's bound P (`maneuver_bound`) at the last knot, subject to `ManeuverLimits`. Derivatives go
backwards through the covariance recursion by CasADi; IPOPT [1]_ minimises log J. J has many minima (which way
to turn first, how often to reverse), so several starts are followed and the best end counts.

The best profile turns at the steepest and rolls at the fastest nearly throughout: J is all but linear along
the way to it. A Hessian that starts small (`_HESSIAN`) lets the solver take the steps of a linear programme;
with IPOPT's own scaling the same starts end 1 to 4 % higher, or at the limit of iterations.

References
----------
.. [1] A. Waechter, L. T. Biegler, "On the implementation of an interior-point filter line-search algorithm
       for large-scale nonlinear programming", Mathematical Programming 106 (2006).
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from pydantic import Field

from ..sins.earth import STANDARD_GRAVITY as G
from ..sins.settings import Settings
from ..sins.units import ARCMIN, ARCSEC, DEG
from .maneuver_bound import (
    AlignmentTask,
    Array,
    bound_function,
    headings,
    knot_covariances,
    knot_times,
)
from .maneuver_limits import ManeuverLimits
from .maneuver_starts import starts

Progress = Callable[[float, float], None]

SLACK = 1e-3
"""Relative excess over a limit that counts as held: what an interior-point method leaves."""


_HESSIAN = 0.01
"""What the quasi-Newton Hessian of log J starts from, 1/rad^2."""


class ManeuverError(RuntimeError):
    """No start reached a profile that holds the limits; one line."""


class SearchOutcome(StrEnum):
    """How the search from one start ended."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration_limit"
    """Holds the limits; a better profile may be near."""
    OUTSIDE_LIMITS = "outside_limits"
    """The solver gave up with a profile that breaks a limit: not used."""


class ManeuverSearch(Settings):
    """What is minimised, and how hard it is tried."""

    heading_weight: float = Field(default=1.0, ge=0, le=1e4)
    """Weight of the heading's variance beside those of the two level axes."""
    knot_s: float = Field(default=0.5, ge=0.1, le=2)
    """Interval of the profile's knots and of the bound's recursion."""
    simple_starts: int = Field(default=8, ge=1, le=8)
    """So many of S-manoeuvres and steepest turns one way and the other are followed."""
    random_starts: int = Field(default=4, ge=0, le=100)
    """Followed besides."""
    seed: int = Field(default=1, ge=0, le=2**31 - 1)
    max_iterations: int = Field(default=150, ge=1, le=5000)


@dataclass(frozen=True)
class Profile:
    """A bank profile with its bound; ``bank`` (n + 1,) rad at knots ``dt`` s apart."""

    bank: Array
    dt: float
    task: AlignmentTask

    @cached_property
    def time(self) -> Array:
        """Of the knots, (n + 1,) s."""
        return knot_times(len(self.bank) - 1, self.dt)

    @cached_property
    def heading(self) -> Array:
        """(n + 1,) rad."""
        return headings(self.bank, self.dt, self.task)

    @cached_property
    def covariance(self) -> Array:
        """Bound on the misalignment at the knots, (n + 1, 3, 3) rad^2."""
        return knot_covariances(self.bank, self.dt, self.task)

    @property
    def level_arcsec(self) -> Array:
        """Bound on level, root mean square of the two axes, at the knots."""
        return np.sqrt(0.5 * (self.covariance[:, 0, 0] + self.covariance[:, 1, 1])) / ARCSEC

    @property
    def heading_arcmin(self) -> Array:
        """Bound on heading at the knots."""
        return np.sqrt(self.covariance[:, 2, 2]) / ARCMIN

    def cost(self, heading_weight: float) -> float:
        """J at the last knot, arcsec^2."""
        north, east, down = np.diag(self.covariance[-1]) / ARCSEC**2
        return float(north + east + heading_weight * down)


@dataclass(frozen=True)
class Attempt:
    """What one start led to."""

    start: str
    profile: Profile
    cost: float
    outcome: SearchOutcome
    solver_status: str
    iterations: int


@dataclass(frozen=True)
class Maneuver:
    """The best profile, and what each start reached."""

    profile: Profile
    outcome: SearchOutcome
    cost: float
    attempts: tuple[Attempt, ...]


def best_maneuver(
    task: AlignmentTask,
    limits: ManeuverLimits,
    search: ManeuverSearch,
    progress: Progress | None = None,
) -> Maneuver:
    """Search from all starts. ``progress`` is called with what is done and the whole.

    Raises ManeuverError if no start led to a profile that holds the limits.
    """
    n = max(round(limits.duration_s / search.knot_s), 8)
    problem, attempts = Problem(task, limits, search, n), []
    named = starts(limits, problem.dt, n, search.simple_starts, search.random_starts, search.seed)
    for name, bank in named.items():
        attempts.append(problem.solve(name, bank))
        if progress:
            progress(len(attempts), len(named))
    usable = [attempt for attempt in attempts if attempt.outcome is not SearchOutcome.OUTSIDE_LIMITS]
    if not usable:
        told = ", ".join(f"{a.start}: {a.solver_status}" for a in attempts)
        raise ManeuverError(f"no start led to a bank profile within the limits ({told})")
    best = min(usable, key=lambda attempt: attempt.cost)
    return Maneuver(best.profile, best.outcome, best.cost, tuple(attempts))


class Problem:
    """The nonlinear programme on one grid of ``n`` intervals; unknowns are the ``n - 1`` inner banks, rad."""

    def __init__(self, task: AlignmentTask, limits: ManeuverLimits, search: ManeuverSearch, n: int) -> None:
        self.task, self.limits, self.search = task, limits, search
        self.dt = limits.duration_s / n
        inner = ca.MX.sym("bank", n - 1)
        bank = ca.vertcat(0, inner, 0)
        trapezia = np.tril(np.ones((n + 1, n + 1))) - 0.5 * np.eye(n + 1)
        trapezia[:, 0] = 0.5
        trapezia[0, 0] = 0.0
        turn = ca.mtimes(ca.DM(self.dt * trapezia), G * ca.tan(bank) / task.speed_mps)
        level, course = bound_function(n, self.dt, task)(bank, task.heading + turn)
        cost = (2 * level + search.heading_weight * course) / ARCSEC**2
        rate = (bank[1:] - bank[:-1]) / self.dt
        acceleration = (ca.vertcat(rate, 0) - ca.vertcat(0, rate)) / self.dt
        excursion = limits.max_heading_excursion_deg * DEG
        self.cost = ca.Function("cost", [inner], [ca.log(cost)])
        """From the inner banks to log J, J in arcsec^2."""
        self._programme = {
            "x": inner,
            "f": ca.log(cost),
            "g": ca.vertcat(
                rate / (limits.max_roll_rate_deg_s * DEG),
                acceleration / (limits.max_roll_acceleration_deg_s2 * DEG),
                turn[1:] / excursion,
                turn[n] / np.pi,
            ),
        }
        self._scaled_limits = np.ones(3 * n + 2)
        options = {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            # The exact Hessian takes as long as some thirty gradients.
            "ipopt.hessian_approximation": "limited-memory",
            "ipopt.limited_memory_max_history": 20,
            "ipopt.limited_memory_initialization": "constant",
            "ipopt.limited_memory_init_val": _HESSIAN,
            "ipopt.mu_strategy": "monotone",
            "ipopt.mu_init": 1e-3,
            "ipopt.tol": 1e-4,
            "ipopt.acceptable_tol": 1e-3,
            "ipopt.max_iter": search.max_iterations,
        }
        self._solver: Any = ca.nlpsol("maneuver", "ipopt", self._programme, options)

    def solve(self, name: str, bank: Array) -> Attempt:
        """Follow the start ``bank``, (n + 1,) rad, to a minimum; what is reached is checked anew."""
        limits, task = self.limits, self.task
        steepest = limits.profile_bank_deg * DEG
        whole = 0.0
        if limits.whole_turns:
            whole = np.round((headings(bank, self.dt, task)[-1] - task.heading) / (2 * np.pi))
        lower, upper = -self._scaled_limits, self._scaled_limits.copy()
        tolerance = limits.course_tolerance_deg / 180
        lower[-1], upper[-1] = 2 * whole - tolerance, 2 * whole + tolerance
        found = self._solver(
            x0=np.clip(bank[1:-1], -steepest, steepest), lbx=-steepest, ubx=steepest, lbg=lower, ubg=upper
        )
        stats = self._solver.stats()
        inner = np.array(found["x"]).ravel()
        profile = Profile(np.concatenate([[0.0], inner, [0.0]]), self.dt, task)
        if not np.isfinite(inner).all() or limits.broken(profile.bank, self.dt, profile.heading, SLACK):
            outcome = SearchOutcome.OUTSIDE_LIMITS
        else:
            outcome = SearchOutcome.CONVERGED if stats["success"] else SearchOutcome.ITERATION_LIMIT
        cost = profile.cost(self.search.heading_weight) if np.isfinite(inner).all() else np.inf
        return Attempt(name, profile, cost, outcome, stats["return_status"], stats["iter_count"])
