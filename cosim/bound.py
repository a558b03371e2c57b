"""The bound of a scenario: what no estimator beats on its flight, its sensors and its fixes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..aircraft.flight import Flight
from ..align.bound import Knowledge, bound
from ..align.estimate import Estimate
from ..network.fixes import Fixes
from ..network.fleet_network import FleetNetwork
from .antenna import at_antenna
from .scenario import Scenario

BOUND_DRAWS = 50
"""Runs over whose fixes the bound is averaged."""
UNMODELLED = (
    "gyro_scale_factor_ppm",
    "accel_scale_factor_ppm",
    "gyro_misalignment_arcsec",
    "accel_misalignment_arcsec",
    "gyro_g_sensitivity_deg_h_g",
    "gyro_quantum_arcsec",
    "accel_quantum_mps",
)
"""Errors of the IMU that the filters have no state and no noise for."""

LASTING = ("range_bias_sd_m", "biased_nodes", "nlos_share", "altitude_bias_sd_m")
"""Settings of the radio whose errors are the same from one fix to the next."""


def bounds_of(scenario: Scenario, window: Flight, fixes: Sequence[Fixes]) -> dict[str, Estimate]:
    """All bounds, by the names of `Knowledge`."""
    return {kind.value: bound_of(scenario, window, fixes, kind) for kind in Knowledge}


def bound_of(
    scenario: Scenario, window: Flight, fixes: Sequence[Fixes], knowledge: Knowledge = Knowledge.STAMPED
) -> Estimate:
    """Posterior Cramer-Rao bound for the fixes of some runs.

    The covariance is the mean over the runs, which differ where packets are lost or come from a network.
    There, errors of fixes count as independent; those of the anchors, which fixes share, can only raise the
    true bound. Where `no_bound_because` has a reason, everything but the time is NaN.
    """
    alike = scenario.fixes.kind == "simulated" and getattr(scenario.fixes, "loss_probability", 0.0) == 0
    bounds = [
        _bound_of_run(scenario, window, of_run, knowledge) for of_run in (fixes[:1] if alike else fixes)
    ]
    known = np.nan if no_bound_because(scenario) else 1.0
    return replace(
        bounds[0],
        lla=known * bounds[0].lla,
        sd=known * np.sqrt(np.mean([bound.sd**2 for bound in bounds], axis=0)),
        misalignment_cov=known * np.mean([bound.misalignment_cov for bound in bounds], axis=0),
    )


def no_bound_because(scenario: Scenario) -> str | None:
    """Why the filter's covariance along the truth is no bound for this scenario, or None if it is one."""
    imu = scenario.imu
    if scenario.fixes.kind == "replay":
        return "the fixes are a recording, one draw of its noise"
    if isinstance(scenario.fixes, FleetNetwork):
        lasting = [name for name in LASTING if getattr(scenario.fixes.radio, name)]
        if lasting:
            return f"{', '.join(lasting)}: errors of the fixes last, and the filter takes them for white"
    if imu.bias_draw != "gaussian":
        return "the biases are not Gaussian"
    for sensor, instability in (
        ("gyro", imu.gyro_bias_instability_deg_h),
        ("accel", imu.accel_bias_instability_ug),
    ):
        if (
            instability > 0
            and getattr(imu, f"{sensor}_bias_correlation_s") < 10 * scenario.alignment.duration_s
        ):
            return f"the filter takes the {sensor} bias for a random walk, which it is not over this time"
    unmodelled = [name for name in UNMODELLED if getattr(imu, name) > 0]
    return f"the filter has no model of {', '.join(unmodelled)}" if unmodelled else None


def _bound_of_run(scenario: Scenario, window: Flight, fixes: Fixes, knowledge: Knowledge) -> Estimate:
    antenna = at_antenna(window, scenario.alignment.settings.lever_arm_b_m)
    return bound(
        window.time,
        window.dtheta_b,
        window.dv_b,
        window.q_nb[0],
        fixes,
        lambda t: antenna.at(t)[:2],
        knowledge,
        scenario.alignment.settings,
        scenario.imu,
        window.gravity,
    )
