"""What an alignment filter yields: the navigation solution, its uncertainty, and an outcome per fix."""

from dataclasses import dataclass, field
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
    IMU_LOST = 4
    """Samples of the IMU had to be held for longer than its patience: the run was stopped there."""


class SampleOutcome(IntEnum):
    """What became of a sample of the IMU that could not be taken as it came; see `align.increments`."""

    NOT_FINITE = 1
    """No number: held."""
    STUCK = 2
    """An axis repeated its last value: held."""
    SATURATED = 3
    """An axis was at its full scale: held there, or where it was before if that is beyond."""
    MISSING = 4
    """It never came: held."""
    OUT_OF_ORDER = 5
    """Its time stamp was behind the others, or ahead of them: refused, and its place held."""
    OUT_OF_RANGE = 6
    """Beyond what the unit can measure: held."""


class NavStatus(IntEnum):
    """What the navigation rested on at a moment, by what had arrived until then."""

    NOT_STARTED = 0
    AIDED = 1
    DEAD_RECKONING = 2
    """No fix was taken for `FilterSettings.dead_reckoning_after_s`, or so many were refused that the next
    starts the filter again: the IMU alone carries on."""
    STOPPED = 3
    """After the run was stopped."""


JUMP_SIGMAS = 3.0
"""A correction beyond so many of the filter's own standard deviations is flagged."""


HISTORIES = (
    *("lla", "v_n", "q_nb", "accel_bias", "gyro_bias"),
    *("delay", "lever_arm_b", "sd", "misalignment_cov", "jump"),
)
"""Columns of an `Estimate`, one row an output, that are NaN where nothing is known."""


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
    fix_jump : (k,) how far the navigation moved when the fix arrived, with those that came with it: greatest
        change of a component of position, velocity or misalignment, over its standard deviation before; NaN
        if the fix was not looked at, or started the navigation, or the method has no covariance.
    status : (m,) `NavStatus`.
    jump : (m,) greatest `fix_jump` since the row before, a restart's and a late fix's included; 0 if none.
    held_imu_samples : rows of the record in which an axis was held or beyond its full scale.
    imu_samples : samples by `SampleOutcome`, where there are any.
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
    fix_jump: Array
    status: NDArray[np.int64]
    jump: Array
    held_imu_samples: int
    outcome: RunOutcome
    imu_samples: dict[SampleOutcome, int] = field(default_factory=dict[SampleOutcome, int])

    @property
    def fused(self) -> NDArray[np.bool_]:
        """(k,) whether the fix corrected a running filter: those whose NIS counts."""
        return self.fix_outcome == FixOutcome.FUSED

    @property
    def jumped(self) -> NDArray[np.bool_]:
        """(m,) whether the row follows a correction beyond `JUMP_SIGMAS`: the flag to a user."""
        return self.jump > JUMP_SIGMAS

    def count(self, outcome: FixOutcome) -> int:
        """Number of fixes that ended so."""
        return int(np.count_nonzero(self.fix_outcome == outcome))
