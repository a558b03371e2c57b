"""The floor: posterior Cramer-Rao bound of an alignment, stamps known.

The trajectory is given and the priors and noises are Gaussian, so the bound is the covariance of the
error-state filter run along the truth: perfect increments, exact fixes, no initial misalignment.

References
----------
.. [1] P. Tichavsky, C. H. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time
       nonlinear filtering", IEEE Transactions on Signal Processing 46 (1998).
"""

from dataclasses import replace

from ..network.fixes import Fixes
from ..sins.earth import GravityModel
from ..sins.imu import ImuErrors
from .estimate import Array, Estimate
from .filters import DelayModel, FilterSettings, align


def stamped_bound(
    time: Array,
    dtheta_b: Array,
    dv_b: Array,
    q_nb: Array,
    fixes: Fixes,
    truth_at_fixes: tuple[Array, Array],
    settings: FilterSettings,
    imu: ImuErrors,
    gravity: GravityModel,
) -> Estimate:
    """Bound along the truth: ``sd`` and ``misalignment_cov`` of the result are what no estimator beats.

    Parameters
    ----------
    time (n,), dtheta_b (n, 3), dv_b (n, 3) : ideal record; q_nb (4,) : true attitude at its start.
    fixes : the fixes as sent; they count from the time of their validity on, without delay.
    truth_at_fixes : true lla (k, 3) and v_n (k, 3) at ``fixes.t_valid``.
    settings, imu, gravity : as for `filters.align`.
    """
    lla, v_n = truth_at_fixes
    exact = replace(fixes, lla=lla, v_n=v_n, t_stamp=fixes.t_valid, t_arrival=fixes.t_valid)
    return align(time, dtheta_b, dv_b, q_nb, exact, DelayModel.STAMPED, settings, imu, gravity)
