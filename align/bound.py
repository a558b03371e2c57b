"""The floor: posterior Cramer-Rao bound of an alignment, with stamps known, with delays unknown, and
afterwards.

The trajectory is given and the priors and noises are Gaussian, so the bound is the covariance of the
error-state filter run along the truth: perfect increments, exact fixes, no initial misalignment. A delay that
nobody tells is one more unknown: its mean a state, its random part, taken for Gaussian of the variance that
the delays really have, a noise along the motion. What the whole record tells of each of its times is the
covariance of the smoother there.

References
----------
.. [1] P. Tichavsky, C. H. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time
       nonlinear filtering", IEEE Transactions on Signal Processing 46 (1998).
"""

from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum

import numpy as np

from ..network.fixes import Fixes
from ..sins.earth import GravityModel
from ..sins.imu import ImuErrors
from ..sins.units import MILLISECOND
from .estimate import Array, Estimate
from .filters import align
from .inputs import AlignmentInput
from .settings import DelayModel, FilterSettings
from .smoother import smooth


class Knowledge(StrEnum):
    """What an estimator has, of which there is a bound each."""

    STAMPED = "stamped"
    """Fixes count from the time of their validity on."""
    DELAY_UNKNOWN = "delay_unknown"
    """Of a fix its arrival is known, and of the mean of the delays no more than the settings' prior."""
    SMOOTHED = "smoothed"
    """All fixes of the record, those after the time included, with their stamps."""


def bound(
    time: Array,
    dtheta_b: Array,
    dv_b: Array,
    q_nb: Array,
    fixes: Fixes,
    antenna_at: Callable[[Array], tuple[Array, Array]],
    knowledge: Knowledge,
    settings: FilterSettings,
    imu: ImuErrors,
    gravity: GravityModel,
) -> Estimate:
    """Bound along the truth: ``sd`` and ``misalignment_cov`` of the result are what no estimator beats.

    Parameters
    ----------
    time (n,), dtheta_b (n, 3), dv_b (n, 3) : ideal record; q_nb (4,) : true attitude at its start.
    fixes : the fixes as sent, with their covariances and times.
    antenna_at : true lla (k, 3) and v_n (k, 3) of the antenna at times (k,) of the record.
    knowledge : what the estimator has of the fixes.
    settings, imu, gravity : as in `AlignmentInput`.
    """

    def given(exact: Fixes, told: FilterSettings) -> AlignmentInput:
        return AlignmentInput.checked(time, dtheta_b, dv_b, q_nb, exact, told, imu, gravity)

    coarse_known = settings.model_copy(update={"coarse_stage": "none"})
    if knowledge is not Knowledge.DELAY_UNKNOWN:
        lla, v_n = antenna_at(fixes.t_valid)
        exact = replace(fixes, lla=lla, v_n=v_n, t_stamp=fixes.t_valid, t_arrival=fixes.t_valid)
        if knowledge is Knowledge.SMOOTHED:
            return smooth(given(exact, coarse_known), relinearized=False)
        return align(given(exact, coarse_known), DelayModel.STAMPED)
    delay = fixes.t_arrival - fixes.t_valid
    mean, sd = (float(np.mean(delay)), float(np.std(delay))) if len(delay) else (0.0, 0.0)
    lla, v_n = antenna_at(np.clip(fixes.t_arrival - mean, time[0], time[-1]))
    known = coarse_known.model_copy(
        update={"delay_mean_ms": mean / MILLISECOND, "delay_sd_ms": sd / MILLISECOND}
    )
    exact = replace(fixes, lla=lla, v_n=v_n)
    return align(given(exact, known), DelayModel.ESTIMATED)
