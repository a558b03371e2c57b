"""Alignment methods by name: what a scenario can ask for.

A method takes each `AlignmentInput` to an `Estimate`.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from .coarse import align_in_motion
from .estimate import HISTORIES, Estimate, NavStatus, RunOutcome
from .filters import CUBATURE_FILTERS, FILTERS, align_all
from .inputs import AlignmentInput
from .problem import pose, to_the_end, unaligned
from .settings import DelayModel, Transform
from .smoother import smooth


@dataclass(frozen=True)
class Method:
    """One way to align."""

    about: str
    run: Callable[[Sequence[AlignmentInput]], list[Estimate]]
    """Over several records of one ``settings``."""
    delay: DelayModel
    """How it treats delays."""
    in_flight: bool = True
    """Whether it runs as fixes arrive, and does not need the whole record."""


def _each(
    align: Callable[[AlignmentInput], Estimate],
) -> Callable[[Sequence[AlignmentInput]], list[Estimate]]:
    return lambda given: [align(one) for one in given]


_POINTS = {Transform.CUBATURE: "cubature points", Transform.SQUARE_ROOT: "points and square roots"}
_DESIGNING = threading.Lock()
"""A design is kept: the first of many runs makes it, and the others wait for it."""


def _designed(given: AlignmentInput, scheduled: bool) -> Estimate:
    from .lmi.alignment import align_lmi, gain_schedule  # cvxpy takes a second to import
    from .lmi.task import sins_plant_settings, steepest_side_mps2

    record = given.record
    side = steepest_side_mps2(record.time, record.increments[:, 3:]) if scheduled else None
    fixes = given.received.fixes
    with _DESIGNING:
        schedule = gain_schedule(sins_plant_settings(fixes, given.settings, given.imu, side or 0.0), side)
    return align_lmi(given, schedule)


def _ekf_ten(given: AlignmentInput) -> Estimate:
    from .lmi.alignment import ekf_ten

    return ekf_ten(given)


METHODS = {
    **{
        name: Method(
            f"error-state filter, delay {delay.name.lower()}", partial(align_all, delay=delay), delay
        )
        for name, delay in FILTERS.items()
    },
    "smoother": Method(
        "fixed-interval smoother, for review after the flight",
        _each(smooth),
        DelayModel.STAMPED,
        in_flight=False,
    ),
    "l2linf_lmi": Method(
        "the paper's ten states, constant gain by an LMI",
        _each(partial(_designed, scheduled=False)),
        DelayModel.IGNORED,
    ),
    "l2linf_lmi_scheduled": Method(
        "the same, gains over the force to the side",
        _each(partial(_designed, scheduled=True)),
        DelayModel.IGNORED,
    ),
    "ekf_ten": Method("EKF on the paper's ten states", _each(_ekf_ten), DelayModel.IGNORED),
    **{
        name: Method(
            f"error-state filter by {_POINTS[transform]}, delay {delay.name.lower()}",
            partial(align_all, delay=delay, transform=transform),
            delay,
        )
        for name, (delay, transform) in CUBATURE_FILTERS.items()
    },
}
"""Methods that a scenario can name."""


def estimate(name: str, given: AlignmentInput) -> Estimate:
    """Align over one record by the method of that name, see `estimates`."""
    return estimates(name, [given])[0]


def estimates(name: str, given: Sequence[AlignmentInput]) -> list[Estimate]:
    """Align over each of several records of one ``settings`` by the method of that name.

    With ``settings.coarse_stage`` "in_motion" the coarse attitude is not looked at: it is found from the
    record first. A filter then runs from the start of the record, as a navigator does that has kept it; what
    the filter gives of the time before that moment is NaN, for nobody knew it then. A smoother knows it
    afterwards.
    """
    method = METHODS[name]
    if all(one.settings.coarse_stage == "none" for one in given):
        return method.run(given)
    return [_from_coarse_stage(method, one) for one in given]


def _from_coarse_stage(method: Method, given: AlignmentInput) -> Estimate:
    problem = pose(given, method.delay)
    found = align_in_motion(problem)
    if found is None:
        return to_the_end(problem, unaligned(problem, RunOutcome.NO_COARSE))
    (fine,) = method.run([replace(given, q_nb_coarse=found.q_nb)])
    return _known_from(fine, found.time) if method.in_flight else fine


def _known_from(fine: Estimate, time: float) -> Estimate:
    """The estimate with everything before a time unknown; fixes of then count as fused all the same."""
    unknown = fine.time < time
    columns = {name: getattr(fine, name).copy() for name in HISTORIES}
    for values in columns.values():
        values[unknown] = np.nan
    status = np.where(unknown, NavStatus.NOT_STARTED, fine.status)
    return replace(fine, **columns, status=status)
