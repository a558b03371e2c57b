"""The paper's own filter on the paper's own model, and an EKF on the same ten states beside it.

`align_lmi` is Gao et al., eqs. (10) to (13): a gain designed by the l2-linf inequality for the ten states of
`sins_plant`, constant, or scheduled over a manoeuvre by the specific force to the side. The error that it
finds is taken out of the navigator at once. `ekf_ten` is the EKF for the same states: biases count as white
noise.

Neither has states for biases, delay or lever arm, nor knows of a time stamp. A constant gain has no
covariance: standard deviations, NIS and gates there are none, and whatever fix arrives is believed.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...sins.imu import ImuErrors
from ..estimate import Estimate, FixOutcome, NavStatus, RunOutcome
from ..filters import align
from ..inputs import AlignmentInput
from ..problem import pose, status_of, to_the_end, unaligned
from ..reception import Integers, Reception
from ..settings import DelayModel
from . import _observer_kernel
from .design import Design, Kind, design
from .plant import Array
from .sins_plant import SinsPlantSettings, level_attitude, nine_of_ten, sins_plant

MIRROR = np.array([1.0, -1.0, 1.0])
"""A turn to the left is one to the right in a mirror along the course, but for the earth's own turn, which no
gain feels. What is an angle changes sign the other way round."""


@dataclass(frozen=True)
class GainSchedule:
    """Gains over the force to the side.

    ``side_mps2`` (s,), increasing; ``gains`` (s, 9, 6), from [position; velocity] that the navigator has too
    much, m and m/s, to its error in position, velocity and misalignment, m, m/s, rad; axes along the course,
    to its right, down. ``designs``: those behind them, level flight first.
    """

    side_mps2: Array
    gains: Array
    designs: tuple[Design, ...]


def gain_schedule(
    settings: SinsPlantSettings, side_mps2: float | None = None, use_cache: bool = True
) -> GainSchedule:
    """Design for level flight, and for steady turns with ``side_mps2`` > 0 to either side unless it is None.

    Each vertex has its own design, in which the inequality holds for that vertex; between them gains are
    interpolated, for which nothing is proven. Raises `design.DesignError`, ValueError.
    """
    if side_mps2 is not None and not side_mps2 > 0:
        raise ValueError(f"side_mps2 = {side_mps2}: must be above 0")
    sides = [0.0] if side_mps2 is None else [0.0, side_mps2]
    designs = [design(sins_plant(settings, side), Kind.FEEDBACK, use_cache=use_cache) for side in sides]
    gains = [
        nine_of_ten(level_attitude(side)) @ found.filter.Bf
        for side, found in zip(sides, designs, strict=True)
    ]
    if side_mps2 is None:
        return GainSchedule(np.zeros(1), np.array(gains), tuple(designs))
    level, right = gains
    into, out = np.tile(MIRROR, 2), np.concatenate([MIRROR, MIRROR, -MIRROR])
    left = out[:, None] * right * into
    return GainSchedule(
        np.array([-side_mps2, 0.0, side_mps2]), np.array([left, level, right]), tuple(designs)
    )


def align_lmi(given: AlignmentInput, schedule: GainSchedule) -> Estimate:
    """Align over one record with given gains.

    Of the settings only ``output_rate_hz``, ``acceleration_window_s``, ``dead_reckoning_after_s`` and
    ``imu_patience_s`` count. The first fix sets position and velocity. Of one source, a packet that was
    overtaken is left out. Biases, delay and lever arm of the result are zero; ``sd``, ``misalignment_cov``
    and ``nis`` are NaN.
    """
    problem, settings = pose(given, DelayModel.IGNORED), given.settings
    reception, n = problem.reception, len(problem.time)
    outcome = _in_order(problem.outcome, reception, n)
    taken = np.flatnonzero(outcome == FixOutcome.FUSED)
    epoch = reception.arrival_epoch[taken]
    X = np.full((len(problem.output_epoch), 10), np.nan)
    innovation = np.full((len(taken), 6), np.nan)
    start, finite = _observer_kernel.run(
        problem.time,
        problem.increments,
        problem.q_nb_coarse,
        (
            epoch,
            reception.lla[taken],
            reception.v_n[taken],
            problem.time[epoch] - reception.t_reference[taken],
        ),
        settings.acceleration_window_s,
        schedule.side_mps2,
        schedule.gains,
        problem.gravity,
        problem.output_epoch,
        (X, innovation),
    )
    started = start < n
    nothing = unaligned(problem, RunOutcome.NO_FIX)
    if not started:
        return to_the_end(problem, nothing)
    outcome[taken[0]] = FixOutcome.INITIALIZED
    known = np.isfinite(X[:, 0])
    fix_time = nothing.fix_time.copy()
    fix_time[taken] = problem.time[epoch]
    every = nothing.innovation.copy()
    every[taken] = innovation
    none = np.where(known, 0.0, np.nan)
    status = status_of(nothing.time, problem.time[epoch], settings.dead_reckoning_after_s)
    stopped = ~known & (status != NavStatus.NOT_STARTED)
    found = replace(
        nothing,
        lla=X[:, 0:3],
        v_n=X[:, 3:6],
        q_nb=X[:, 6:10],
        accel_bias=np.tile(none[:, None], 3),
        gyro_bias=np.tile(none[:, None], 3),
        delay=none,
        lever_arm_b=np.tile(none[:, None], 3),
        innovation=every,
        fix_time=fix_time,
        fix_outcome=outcome,
        status=np.where(stopped, NavStatus.STOPPED, status),
        outcome=RunOutcome.ALIGNED if finite else RunOutcome.NOT_FINITE,
    )
    return to_the_end(problem, found)


def _in_order(outcome: Integers, reception: Reception, n: int) -> Integers:
    """FUSED for each pending fix that arrives in time, unless it was seen before or overtaken."""
    outcome, seen = outcome.copy(), set()
    newest: dict[int, int] = {}
    for fix in np.flatnonzero((outcome == FixOutcome.PENDING) & (reception.arrival_epoch < n)):
        packet, source, sequence = (
            int(of[fix]) for of in (reception.packet, reception.source, reception.sequence)
        )
        if packet in seen:
            outcome[fix] = FixOutcome.DUPLICATE
        elif sequence < newest.get(source, sequence):
            outcome[fix] = FixOutcome.LATE
        else:
            outcome[fix] = FixOutcome.FUSED
            seen.add(packet)
            newest[source] = sequence
    return outcome


def ekf_ten(given: AlignmentInput, held_s: float = 0.1) -> Estimate:
    """The EKF on the ten states: delay ignored, biases white.

    The tenth, the error of the quaternion's norm, is zero in a navigator that normalises; the filter of the
    project without its bias states is what is left. ``held_s`` : a bias counts as noise that is drawn anew
    after so many seconds, as in the design of `align_lmi` from fix to fix.
    """
    return align(replace(given, imu=white(given.imu, held_s)), DelayModel.IGNORED)


def white(imu: ImuErrors, held_s: float) -> ImuErrors:
    """The error budget with biases, held for ``held_s``, among the white noise."""
    hour = 3600.0
    accel = np.sqrt(
        imu.accel_vrw_ug_sqrt_hz**2 + (imu.accel_bias_ug**2 + imu.accel_bias_instability_ug**2) * held_s
    )
    gyro = np.sqrt(
        imu.gyro_arw_deg_sqrt_h**2
        + (imu.gyro_bias_deg_h**2 + imu.gyro_bias_instability_deg_h**2) * held_s / hour
    )
    return imu.model_copy(
        update={
            "accel_vrw_ug_sqrt_hz": float(accel),
            "gyro_arw_deg_sqrt_h": float(gyro),
            "accel_bias_ug": 0.0,
            "gyro_bias_deg_h": 0.0,
            "accel_bias_instability_ug": 0.0,
            "gyro_bias_instability_deg_h": 0.0,
        }
    )
