"""A replay: the filters on a recording, and what there is to say of them without a truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..align.estimate import Array, Estimate
from ..align.inputs import AlignmentInput
from ..align.methods import METHODS, estimate
from ..align.settings import DelayModel, FilterSettings
from ..network.fixes import Fixes
from ..network.tables import TableError
from ..sins import attitude
from ..sins.error_model import POSITION, VELOCITY
from ..sins.units import DEG, MILLISECOND
from .replay_checks import check_imu, check_together, check_upright, course_offset
from .replay_map import ReplayError, ReplayMap
from .replay_read import RecordedImu, read_imu, read_recorded_fixes
from .replay_time import TimeBase

COMPONENTS = ("north_m", "east_m", "down_m", "v_north_mps", "v_east_mps", "v_down_mps")
"""Of an innovation."""
_PER_FIX = ("innovation", "nis", "fix_time", "fix_outcome", "fix_jump")
_MOST_ROWS, _MOST_HZ = 200_000, 1000.0
"""Of the history from which standard deviations of innovations are taken."""


@dataclass(frozen=True)
class Replay:
    """What was read of a recording, and what the filters made of it.

    ``estimates`` at the output rate, ``innovation_sd`` (k, 6) in m and m/s, both by filter; ``fixes`` in
    order of arrival.
    """

    files: tuple[Path, Path]
    settings: ReplayMap
    imu: RecordedImu
    fixes: Fixes
    fix_base: TimeBase
    checks: dict[str, float | None]
    estimates: dict[str, Estimate]
    innovation_sd: dict[str, Array]

    @property
    def started(self) -> dict[str, Estimate]:
        """Estimates of those filters that had a fix to start from."""
        return {name: e for name, e in self.estimates.items() if np.isfinite(e.lla).any()}


def replay(
    imu_file: Path, fixes_file: Path, settings: ReplayMap, progress: Callable[[float, float], None]
) -> Replay:
    """Read, check and align. Raises `ReplayError`, one line: file, row or column, value, what is allowed."""
    euler, initial = settings.euler, settings.initial
    steps = len(settings.alignment.filters) + 1
    try:
        imu = read_imu(imu_file, settings.recorded, initial.time_s if initial else None)
        checks: dict[str, float | None] = {**check_imu(imu_file, imu, settings.recorded.imu)}
        checks |= {"tilt_deg": None, "heading_minus_course_deg": None}
        if euler is not None:
            q_nb = attitude.from_euler(*euler)
            checks["tilt_deg"] = check_upright(imu_file, imu, q_nb, settings.recorded.imu) / DEG
        fixes, fix_base = read_recorded_fixes(fixes_file, settings.recorded)
    except TableError as error:
        raise ReplayError(str(error)) from error
    checks |= check_together((imu_file, fixes_file), imu, fixes, settings.recorded)
    offset = None if euler is None else course_offset(fixes, float(euler[2]))
    if offset is not None:
        checks["heading_minus_course_deg"] = offset / DEG
    progress(1, steps)
    estimates, innovation_sd = {}, {}
    given, kept = _given(imu, fixes, settings)
    for done, name in enumerate(settings.alignment.filters, start=2):
        estimates[name], innovation_sd[name] = _aligned(name, given, kept, fixes, settings)
        progress(done, steps)
    files = imu_file, fixes_file
    return Replay(files, settings, imu, fixes, fix_base, checks, estimates, innovation_sd)


def _given(imu: RecordedImu, fixes: Fixes, settings: ReplayMap) -> tuple[AlignmentInput, int]:
    """What all filters are given; they put out finer than asked, and of so many rows one is to be kept."""
    filter_settings, dt = settings.settings, imu.base.interval_s
    # A history of every sample tells what a fix met; a thinner one is kept.
    wanted = max(1, round(1 / (filter_settings.output_rate_hz * dt)))
    finer = max(1, len(imu.time) // _MOST_ROWS, round(1 / (_MOST_HZ * dt)))
    kept = max(1, round(wanted / finer))
    every = finer if kept > 1 else wanted
    rate = min(1 / (every * dt), _MOST_HZ)
    euler = np.zeros(3) if settings.euler is None else settings.euler
    given = AlignmentInput.checked(
        imu.time,
        imu.dtheta_b,
        imu.dv_b,
        attitude.from_euler(*euler),
        fixes,
        filter_settings.model_copy(update={"output_rate_hz": rate}),
        settings.imu,
        settings.gravity_model,
    )
    return given, kept


def _aligned(
    name: str, given: AlignmentInput, kept: int, fixes: Fixes, settings: ReplayMap
) -> tuple[Estimate, Array]:
    """Estimate at the output rate, and standard deviations of its innovations, (k, 6)."""
    history, method = estimate(name, given), METHODS[name]
    if not method.in_flight:
        # What a smoother is sure of is not what its filter was, when the fix came.
        return _thinned(history, kept), np.full((len(fixes), 6), np.nan)
    sd = _innovation_sd(history, fixes, method.delay, settings.settings, settings.imu.vibration_mps)
    return _thinned(history, kept), sd


def _thinned(estimate: Estimate, every: int) -> Estimate:
    rows = np.unique(np.append(np.arange(every - 1, len(estimate.time), every), len(estimate.time) - 1))
    histories = {
        name: value[rows]
        for name, value in vars(estimate).items()
        if isinstance(value, np.ndarray) and name not in _PER_FIX
    }
    return replace(estimate, **histories)


def _innovation_sd(
    estimate: Estimate, fixes: Fixes, delay: DelayModel, settings: FilterSettings, vibration_mps: float
) -> Array:
    """Standard deviations that the filter gave its innovations, (k, 6); NaN where there was no update.

    From the row before the fix. The covariance of a delay that is estimated is left out: along the track
    they are too large by what position and delay have in common.
    """
    row = np.searchsorted(estimate.time, estimate.fix_time - 1e-6) - 1
    known = (row >= 0) & np.isfinite(estimate.fix_time)
    row = np.maximum(np.where(known, row, 0), 0)
    before = np.searchsorted(estimate.time, estimate.time[row] - settings.acceleration_window_s)
    before = np.minimum(before, np.maximum(row - 1, 0))
    elapsed = np.maximum(estimate.time[row] - estimate.time[before], 1e-9)[:, None]
    acceleration = np.nan_to_num((estimate.v_n[row] - estimate.v_n[before]) / elapsed)
    moving = np.hstack([estimate.v_n[row], acceleration])
    spread_ms = {DelayModel.STAMPED: settings.stamp_sd_ms, DelayModel.ESTIMATED: settings.delay_sd_ms}
    variance = estimate.sd[row][:, [*range(POSITION.start, VELOCITY.stop)]] ** 2
    variance += np.einsum("kii->ki", fixes.cov) + (moving * spread_ms.get(delay, 0.0) * MILLISECOND) ** 2
    variance[:, 3:] += vibration_mps**2
    return np.where(known[:, None], np.sqrt(variance), np.nan)


def attitude_sd(estimate: Estimate) -> Array:
    """Standard deviations of roll, pitch and heading, rad, (m, 3), at the estimated attitude."""
    T = attitude.attitude_error_matrix(estimate.q_nb)
    return np.sqrt(np.einsum("mij,mjk,mik->mi", T, estimate.misalignment_cov, T))
