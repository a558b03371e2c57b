"""What an alignment is given: a record of the IMU and fixes, both checked, and what filters are told of them.

Made once; all methods that are to align on the same data share it, and none writes to it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..network.fixes import Fixes
from ..sins.earth import GravityModel
from ..sins.imu import ImuErrors
from .estimate import Array
from .increments import Record, conditioned
from .reception import Integers, Received, received
from .settings import FilterSettings


@dataclass(frozen=True)
class AlignmentInput:
    """What one alignment is given; `checked` makes it of arrays."""

    record: Record
    received: Received
    q_nb_coarse: Array
    """(4,) attitude at the start of the record, wrong by the initial misalignment."""
    settings: FilterSettings
    imu: ImuErrors
    """The error budget that filters are told."""
    gravity: GravityModel
    """The model to navigate with."""

    @cached_property
    def dt(self) -> float:
        """Mean interval, s."""
        time, end = self.record.time, self.record.end
        return float(time[end - 1] - time[0]) / (end - 1)

    @cached_property
    def output_epochs(self) -> tuple[Integers, Integers]:
        """Epochs at which filters put out, at ``output_rate_hz`` and the last; and those for which there is
        nothing to put out, the IMU being lost."""
        n, end = len(self.record.time), self.record.end
        every = max(1, round(1 / (self.settings.output_rate_hz * self.dt)))
        epochs = np.arange(every, n, every)
        if not len(epochs) or epochs[-1] < n - 1:
            epochs = np.append(epochs, n - 1)
        lost = epochs >= end
        return epochs[~lost], epochs[lost]

    @classmethod
    def checked(
        cls,
        time: ArrayLike,
        dtheta_b: ArrayLike,
        dv_b: ArrayLike,
        q_nb_coarse: ArrayLike,
        fixes: Fixes,
        settings: FilterSettings,
        imu: ImuErrors,
        gravity: GravityModel,
        span_s: tuple[float, float] | None = None,
    ) -> "AlignmentInput":
        """Of what was measured.

        Parameters
        ----------
        time : (n,) s. dtheta_b, dv_b : (n, 3) rad and m/s over the interval that ends at ``time``.
        q_nb_coarse : (4,) attitude at ``time[0]``, or where ``span_s`` begins.
        fixes : in any order; taken by arrival.
        span_s : s, from when, which is where the coarse attitude belongs, to when there should be samples;
            None: from the first that came to the last.

        Samples and fixes that are broken are found here: such a sample is replaced, at a cost to the
        covariance (`increments`), such a fix has the reason for its outcome (`reception`).

        Raises ValueError for arrays that do not make up a record (`increments.conditioned`) or an attitude
        that is no unit quaternion.
        """
        record = conditioned(time, dtheta_b, dv_b, imu, settings.imu_patience_s, span_s)
        q_nb_coarse = np.array(q_nb_coarse, float)
        if q_nb_coarse.shape != (4,) or not abs(np.linalg.norm(q_nb_coarse) - 1) < 1e-6:
            raise ValueError(f"q_nb_coarse must be a unit quaternion, not {q_nb_coarse}")
        found = received(record.time[: record.end], fixes)
        return cls(record, found, q_nb_coarse, settings, imu, gravity)
