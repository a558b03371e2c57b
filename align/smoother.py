"""Fixed-interval smoother: what the whole record tells of each epoch, for review after the flight.

The filter goes forward, trusting stamps, and the adjoint of its error state goes back. Both linearise about
the filter's trajectory, which begins with the whole initial misalignment and goes astray with the first
fixes' noise. So they go twice: the second time from the smoothed attitude of the start, held to `WEIGHTLESS`
times its standard deviation, or that of the coarse attitude if this is less.

References
----------
.. [1] G. J. Bierman, "Fixed interval smoothing with discrete measurements", International Journal of
       Control 18 (1973): the modified Bryson-Frazier form.
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd ed.,
       section 3.4.5.
"""

from dataclasses import replace

import numpy as np

from ..sins import attitude
from ..sins.error_model import MISALIGN
from . import _memory, _smoothing_kernel
from ._kernels import N_X
from .estimate import Array, Estimate, FixOutcome, RunOutcome
from .inputs import AlignmentInput
from .problem import Problem, pose, run, state_columns, to_the_end
from .reception import Integers, Reception
from .settings import DelayModel

WEIGHTLESS = 30.0
"""So many times the standard deviation that a record gives leave what is known before a weight of 0.1 %."""


def smooth(given: AlignmentInput, relinearized: bool = True) -> Estimate:
    """Smooth over one record; stamps are trusted.

    Returns the smoothed states with their covariance; innovations, NIS and outcomes are those of the filter
    that went forward, to which no fix of the record comes too late. A restart of the filter divides the
    record.

    ``relinearized``: whether to go twice, which a record that begins with the true attitude has no need of.
    """
    problem = pose(given, DelayModel.STAMPED)
    return to_the_end(problem, _both_ways(problem, relinearized))


def _both_ways(problem: Problem, relinearized: bool) -> Estimate:
    """Forward and back, twice if ``relinearized``."""
    received = problem.outcome.copy()
    filtered, kept = _filtered(problem)
    if filtered.outcome is not RunOutcome.ALIGNED:
        return filtered
    if not relinearized:
        return _smoothed(problem, filtered, kept)
    first = problem.reception.reference_epoch[_applied(problem)[:1]]
    X, variance, _ = _back(problem, kept, first)
    correction = attitude.multiply(X[0, 6:10], attitude.conjugate(kept[0][first[0], 6:10]))
    sd = problem.initial_sd.copy()
    sd[MISALIGN] = np.minimum(sd[MISALIGN], WEIGHTLESS * np.sqrt(variance[0, MISALIGN]))
    problem = problem._replace(
        q_nb_coarse=attitude.multiply(correction, problem.q_nb_coarse), initial_sd=sd, outcome=received
    )
    filtered, kept = _filtered(problem)
    if filtered.outcome is not RunOutcome.ALIGNED:
        return filtered
    return _smoothed(problem, filtered, kept)


def _smoothed(problem: Problem, filtered: Estimate, kept: tuple[Array, Array]) -> Estimate:
    X, variance, misalignment_cov = _back(problem, kept, problem.output_epoch)
    return replace(filtered, **state_columns(X), sd=np.sqrt(variance), misalignment_cov=misalignment_cov)


def _filtered(problem: Problem) -> tuple[Estimate, tuple[Array, Array]]:
    return run(problem._replace(horizon=len(problem.time)))


def _applied(problem: Problem) -> Integers:
    """The fixes that the filter took, in the order in which it did."""
    fixes = problem.reception
    taken = np.isin(problem.outcome, (FixOutcome.FUSED, FixOutcome.INITIALIZED))
    order = np.lexsort((fixes.packet, fixes.t_reference, fixes.reference_epoch))
    return order[taken[order]]


def _back(problem: Problem, kept: tuple[Array, Array], wanted: Integers) -> tuple[Array, Array, Array]:
    """Smoothed states (m, 22), variances (m, n) and covariances of misalignment (m, 3, 3) at m wanted
    epochs."""
    m, states = len(wanted), len(problem.initial_sd)
    X, variance, misalignment_cov = (np.full(shape, np.nan) for shape in ((m, N_X), (m, states), (m, 3, 3)))
    applied = _applied(problem)
    restarts = problem.outcome[applied] == FixOutcome.INITIALIZED
    restarts[0] = False
    _smoothing_kernel.smooth(
        problem.time,
        problem.increments,
        problem.gap_variance,
        Reception._make(column[applied] for column in problem.reception),
        restarts,
        int(problem.delay),
        problem.delay_sd,
        problem.initial,
        problem.initial_sd,
        problem.noise_density,
        problem.vibration_variance,
        problem.samples,
        problem.gravity,
        wanted,
        *kept,
        (X, variance, misalignment_cov),
        _memory.steps_memory(states),
    )
    return X, variance, misalignment_cov
