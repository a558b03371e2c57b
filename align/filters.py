"""Alignment filters by name: one closed-loop error-state filter, three ways to treat a fix's delay.

``ekf``
    Takes a fix for the present when it arrives: the EKF of Gao et al.
``ekf_stamped``
    Trusts the stamp and applies the fix at the time of its validity: what clocks in common make possible.
``l2linf``
    Has no stamp: estimates the mean delay as a state and puts its random part into the measurement noise.
    This is the finite-horizon energy-to-peak (l2-linf) filter; `docs/derivations.md` derives it and
    relates it to Theorem 2 of Gao et al.

``ckf_stamped`` and ``srckf_stamped`` are ``ekf_stamped`` by cubature points instead of derivatives, on the
covariance and on its square root; ``ckf_l2linf`` and ``srckf_l2linf`` likewise stand where ``l2linf`` does.

References
----------
.. [1] C. Gao, J. Lu, G. Zhao, S. Pan, "A Localization and In-flight Alignment Protocol for Airborne
       SINS Based on Flight-vehicle Wireless Sensor Networks", eqs. (10) to (13), Table 1.
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation
       Systems", 2nd ed., section 14.2.
.. [3] I. Arasaratnam, S. Haykin, "Cubature Kalman Filters", IEEE Transactions on Automatic Control 54 (2009).
"""

from collections.abc import Sequence

from .estimate import Estimate
from .inputs import AlignmentInput
from .problem import pose, run_all, to_the_end
from .settings import DelayModel, Transform

FILTERS = {"ekf": DelayModel.IGNORED, "ekf_stamped": DelayModel.STAMPED, "l2linf": DelayModel.ESTIMATED}
"""Error-state filters by derivatives."""
CUBATURE_FILTERS = {
    f"{short}_{name}": (delay, transform)
    for short, transform in (("ckf", Transform.CUBATURE), ("srckf", Transform.SQUARE_ROOT))
    for name, delay in (("stamped", DelayModel.STAMPED), ("l2linf", DelayModel.ESTIMATED))
}
"""The same by cubature points."""


def align(given: AlignmentInput, delay: DelayModel, transform: Transform = Transform.DERIVATIVES) -> Estimate:
    """Align over one record, see `align_all`."""
    return align_all([given], delay, transform)[0]


def align_all(
    given: Sequence[AlignmentInput], delay: DelayModel, transform: Transform = Transform.DERIVATIVES
) -> list[Estimate]:
    """Align over each of several records of one ``settings``, as it would happen: a fix counts from its
    arrival on.

    ``delay`` : how to treat delays. ``transform`` : how covariances are carried.

    The first fix starts position and velocity; after ``restart_after_gated`` refused ones in a row the next
    one does so again, with the attitude of then and the uncertainty of the start.

    Returns the estimates at ``output_rate_hz`` and at the end. Samples and fixes that are broken never enter
    the state; both are counted.
    """
    problems = [pose(one, delay) for one in given]
    return [to_the_end(*found) for found in zip(problems, run_all(problems, transform), strict=True)]
