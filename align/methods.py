"""Alignment methods by name: what a scenario can ask for.

A method takes a record from a coarse attitude, or from none, to an `Estimate`.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..network.fixes import Fixes
from ..sins.earth import GravityModel
from ..sins.imu import ImuErrors
from .coarse import align_in_motion
from .estimate import HISTORIES, Array, Estimate, NavStatus, RunOutcome
from .filters import CUBATURE_FILTERS, FILTERS, align
from .problem import pose, to_the_end, unaligned
from .settings import DelayModel, FilterSettings, Transform
from .smoother import smooth


@dataclass(frozen=True)
class Method:
    """One way to align."""

    about: str
    run: Callable[..., Estimate]
    """Of time, dtheta_b, dv_b, q_nb_coarse, fixes, settings, imu, gravity, as `filters.align` has them."""
    delay: DelayModel
    """How it treats delays."""
    in_flight: bool = True
    """Whether it runs as fixes arrive, and does not need the whole record."""


_POINTS = {Transform.CUBATURE: "cubature points", Transform.SQUARE_ROOT: "points and square roots"}
_DESIGNING = threading.Lock()
"""A design is kept: the first of many runs makes it, and the others wait for it."""


def _filter(delay: DelayModel, transform: Transform = Transform.DERIVATIVES) -> Callable[..., Estimate]:
    def run(*record: Any) -> Estimate:
        *measured, settings, imu, gravity = record
        return align(*measured, delay=delay, settings=settings, imu=imu, gravity=gravity, transform=transform)

    return run


def _designed(
    time: ArrayLike,
    dtheta_b: ArrayLike,
    dv_b: ArrayLike,
    q_nb: ArrayLike,
    fixes: Fixes,
    settings: FilterSettings,
    imu: ImuErrors,
    gravity: GravityModel,
    scheduled: bool,
) -> Estimate:
    from .lmi.alignment import align_lmi, gain_schedule  # cvxpy takes a second to import
    from .lmi.task import sins_plant_settings, steepest_side_mps2

    side = steepest_side_mps2(time, dv_b) if scheduled else None
    with _DESIGNING:
        schedule = gain_schedule(sins_plant_settings(fixes, settings, imu, side or 0.0), side)
    return align_lmi(time, dtheta_b, dv_b, q_nb, fixes, schedule, settings, gravity)


def _ekf_ten(*record: Any) -> Estimate:
    from .lmi.alignment import ekf_ten

    return ekf_ten(*record)


METHODS = {
    **{
        name: Method(f"error-state filter, delay {delay.name.lower()}", _filter(delay), delay)
        for name, delay in FILTERS.items()
    },
    "smoother": Method(
        "fixed-interval smoother, for review after the flight", smooth, DelayModel.STAMPED, in_flight=False
    ),
    "l2linf_lmi": Method(
        "the paper's ten states, constant gain by an LMI",
        partial(_designed, scheduled=False),
        DelayModel.IGNORED,
    ),
    "l2linf_lmi_scheduled": Method(
        "the same, gains over the force to the side",
        partial(_designed, scheduled=True),
        DelayModel.IGNORED,
    ),
    "ekf_ten": Method("EKF on the paper's ten states", _ekf_ten, DelayModel.IGNORED),
    **{
        name: Method(
            f"error-state filter by {_POINTS[transform]}, delay {delay.name.lower()}",
            _filter(delay, transform),
            delay,
        )
        for name, (delay, transform) in CUBATURE_FILTERS.items()
    },
}
"""Methods that a scenario can name."""


def estimate(
    name: str,
    time: ArrayLike,
    dtheta_b: ArrayLike,
    dv_b: ArrayLike,
    q_nb_coarse: Array,
    fixes: Fixes,
    settings: FilterSettings,
    imu: ImuErrors,
    gravity: GravityModel,
) -> Estimate:
    """Align over one record by the method of that name; parameters and errors are those of `filters.align`.

    With ``settings.coarse_stage`` "in_motion" the coarse attitude is not looked at: it is found from the
    record first. A filter then runs from the start of the record, as a navigator does that has kept it; what
    the filter gives of the time before that moment is NaN, for nobody knew it then. A smoother knows it
    afterwards.
    """
    method = METHODS[name]
    record = (time, dtheta_b, dv_b, q_nb_coarse, fixes)
    if settings.coarse_stage == "none":
        return method.run(*record, settings, imu, gravity)
    problem = pose(*record, method.delay, settings, imu, gravity)
    found = align_in_motion(problem)
    if found is None:
        return to_the_end(problem, unaligned(problem, RunOutcome.NO_COARSE))
    fine = method.run(*record[:3], found.q_nb, fixes, settings, imu, gravity)
    return _known_from(fine, found.time) if method.in_flight else fine


def _known_from(fine: Estimate, time: float) -> Estimate:
    """The estimate with everything before a time unknown; fixes of then count as fused all the same."""
    unknown = fine.time < time
    columns = {name: getattr(fine, name).copy() for name in HISTORIES}
    for values in columns.values():
        values[unknown] = np.nan
    status = np.where(unknown, NavStatus.NOT_STARTED, fine.status)
    return replace(fine, **columns, status=status)
