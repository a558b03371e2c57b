"""What an alignment filter yields: the navigation solution, its uncertainty, and an outcome per fix."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class FixOutcome(IntEnum):
    """What became of one received fix."""

    PENDING = 0
    """Arrived after the end of the record, or after the run was stopped."""
    FUSED = 1
    INITIALIZED = 2
    """Started the navigation, or started it again: position and velocity were taken from it."""
    GATED = 3
    """Its innovation lay outside the gate."""
    DUPLICATE = 4
    """The same source had sent the same sequence number before."""
    LATE = 5
    """Valid before the record or the horizon; without a trusted stamp, overtaken by a younger packet."""
    NOT_FINITE = 6
    """A NaN or an infinity in it."""
    FUTURE = 7
    """Stamped later than it arrived."""
    INVALID = 8
    """No fix: latitude beyond a pole, or a covariance that is not symmetric and positive definite."""
    UNAUTHENTIC = 9
    """The receiver refused its tag, or its age (`network.authentication`)."""


class RunOutcome(IntEnum):
    """How a whole alignment ended."""

    ALIGNED = 0
    NO_FIX = 1
    """No usable fix arrived: the navigation never started."""
    NOT_FINITE = 2
    """State or covariance lost meaning: the run was stopped there."""
    NO_COARSE = 3
    """The motion never told enough of the attitude to start a filter from."""


@dataclass(frozen=True)
class Estimate:
    """History of one filter over one record; rows before the first fix are NaN.

    Attributes
    ----------
    time : (m,) s.
    lla, v_n, q_nb : (m, 3) rad, rad, m; (m, 3) m/s, NED; (m, 4).
    accel_bias, gyro_bias : (m, 3) m/s^2 and rad/s, body.
    delay : (m,) estimated mean delay of the fixes, s.
    lever_arm_b : (m, 3) from IMU to antenna, body, m.
    sd : (m, 16) standard deviations of the 15 states of `sins.error_model` and of the delay; (m, 19) with
        those of the lever arm where it is estimated.
    misalignment_cov : (m, 3, 3) covariance of the misalignment, NED, rad^2.
    innovation : (k, 6) predicted minus received, position NED in m and velocity in m/s, NaN if not computed.
    nis : (k,) normalised innovation squared.
    fix_time : (k,) s, epoch at which the fix was (last) applied, NaN if it was not.
    fix_outcome : (k,) `FixOutcome`.
    held_imu_samples : number of IMU samples that were not finite and replaced by the last good one.
    outcome : `RunOutcome`.
    """

    time: Array
    lla: Array
    v_n: Array
    q_nb: Array
    accel_bias: Array
    gyro_bias: Array
    delay: Array
    lever_arm_b: Array
    sd: Array
    misalignment_cov: Array
    innovation: Array
    nis: Array
    fix_time: Array
    fix_outcome: NDArray[np.int64]
    held_imu_samples: int
    outcome: RunOutcome

    @property
    def fused(self) -> NDArray[np.bool_]:
        """(k,) whether the fix corrected a running filter: those whose NIS counts."""
        return self.fix_outcome == FixOutcome.FUSED

    def count(self, outcome: FixOutcome) -> int:
        """Number of fixes that ended so."""
        return int(np.count_nonzero(self.fix_outcome == outcome))
