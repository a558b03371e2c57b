"""Alignment methods by name: what a scenario can ask for.

A method takes a record from a coarse attitude, or from none, to an `Estimate`.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..network.fixes import Fixes
from ..sins.earth import GravityModel
from ..sins.imu import ImuErrors
from .coarse import align_in_motion
from .estimate import Array, Estimate, RunOutcome
from .filters import FILTERS, DelayModel, FilterSettings, align, pose, unaligned
from .smoother import smooth


@dataclass(frozen=True)
class Method:
    """One way to align."""

    about: str
    delay: DelayModel
    """How it treats delays."""
    smoothed: bool = False


METHODS = {
    **{
        name: Method(f"error-state filter, delay {delay.name.lower()}", delay)
        for name, delay in FILTERS.items()
    },
    "smoother": Method(
        "fixed-interval smoother, for review after the flight", DelayModel.STAMPED, smoothed=True
    ),
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
        return _fine(method, *record, settings, imu, gravity)
    problem = pose(*record, method.delay, settings, imu, gravity)
    found = align_in_motion(problem)
    if found is None:
        return unaligned(problem, RunOutcome.NO_COARSE)
    fine = _fine(method, *record[:3], found.q_nb, fixes, settings, imu, gravity)
    return fine if method.smoothed else _known_from(fine, found.time)


def _fine(
    method: Method,
    time: ArrayLike,
    dtheta_b: ArrayLike,
    dv_b: ArrayLike,
    q_nb: ArrayLike,
    fixes: Fixes,
    settings: FilterSettings,
    imu: ImuErrors,
    gravity: GravityModel,
) -> Estimate:
    if method.smoothed:
        return smooth(time, dtheta_b, dv_b, q_nb, fixes, settings, imu, gravity)
    return align(time, dtheta_b, dv_b, q_nb, fixes, method.delay, settings, imu, gravity)


def _known_from(fine: Estimate, time: float) -> Estimate:
    """The estimate with everything before a time unknown; fixes of then count as fused all the same."""
    unknown = fine.time < time
    names = (
        "lla",
        "v_n",
        "q_nb",
        "accel_bias",
        "gyro_bias",
        "delay",
        "lever_arm_b",
        "sd",
        "misalignment_cov",
    )
    columns = {name: getattr(fine, name).copy() for name in names}
    for values in columns.values():
        values[unknown] = np.nan
    return replace(fine, **columns)
