"""From any heading: the two stages of the product beside single filters that start with no heading."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from fleetalign.aircraft.flight import Flight
from fleetalign.align.coarse import CoarseAttitude, align_in_motion
from fleetalign.align.estimate import Estimate
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.methods import estimate
from fleetalign.align.problem import pose
from fleetalign.align.settings import DelayModel
from fleetalign.cosim.bound import bound_of
from fleetalign.cosim.resampling import paired_ratios
from fleetalign.cosim.run import Run, simulate
from fleetalign.cosim.scenario import Scenario, replaced
from fleetalign.cosim.score import errors_against, standard_deviations

from .harness import Harness, Row
from .invariant_filter import Aligned, Array, Error, InvariantFilter, Records, condensed
from .material import SEED, Material

TILT_DEG = 5.0
CHANGES = {
    "fixes.delay": {"kind": "none"},
    "alignment.coarse": {"unknown_heading": True, "roll_error_deg": TILT_DEG, "pitch_error_deg": TILT_DEG},
    "alignment.settings.coarse_stage": "in_motion",
    "alignment.filters": ["ekf_stamped"],
}
"""Any heading, and fixes that are not late."""
LEVEL_SD_DEG = TILT_DEG / np.sqrt(3)
HEADING_SD_DEG = (60.0, 180 / np.sqrt(3), 360.0)
"""Priors; the second has the variance of a heading that is uniform on the circle."""
STEP_S = 0.05
"""Over which the filters in numpy take increments together."""
SIGMAS = 3.0
HEADING_LIMIT_ARCMIN = 60.0


def rows(harness: Harness, material: Material) -> list[Row]:
    """One row for each kind of error and prior, all on the same runs."""
    scenario, window = replaced(material.scenario, CHANGES), material.window
    count = harness.size.coarse_runs
    runs = [simulate(scenario, window, i, SEED) for i in range(count)]
    records = records_of(runs, STEP_S)
    made: dict[str, Any] = {}

    def kept(name: str, subject: Callable[..., object], *arguments: object) -> Callable[[], object]:
        return lambda: made.update({name: subject(*arguments)})

    subjects = {
        "ours": kept("ours", _two_stages, scenario, window, runs),
        "coarse stage": partial(_coarse_stages, scenario, window, runs),
    }
    for error in Error:
        for sd in HEADING_SD_DEG:
            single = InvariantFilter(error, LEVEL_SD_DEG, sd, scenario.imu, window.gravity)
            name = f"{error.value} error, prior {sd:.0f} deg"
            subjects[name] = kept(name, single.align, records)
    times = harness.times("coarse", subjects, rounds=1, warm_up=False)
    cpu_ms = {name: 1e3 * timing.best / count for name, timing in times.items()}
    ours = np.array([errors_against(window, one) for one in made.pop("ours")])
    # The filter of the product gives nothing of the record's first epoch, where the first fix is.
    theirs = {name: of_runs(window, aligned)[:, 1:] for name, aligned in made.items()}
    since = (records.time[records.epochs] - records.time[0])[1:]
    bound = bound_of(scenario, window, [runs[0].fixes])
    limit = SIGMAS * standard_deviations(window, bound, scenario.imu.vibration_mps)[-1, :3]
    cpu_ms = {name: 1e3 * timing.best / count for name, timing in times.items()}
    note = (
        f"{count} runs of {window.time[-1] - window.time[0]:.0f} s, heading uniform on the circle, tilt up to"
        f" {TILT_DEG:.0f} deg; records, fixes and starts are the same for all, and fixes have no delay. Ours:"
        " `methods.estimate`, `ekf_stamped` after the coarse stage, compiled; of its time"
        f" {cpu_ms['coarse stage']:.1f} ms are the coarse stage's. The reference is `invariant_filter.py`:"
        f" numpy on all runs at once, increments of {1e3 * STEP_S:.0f} ms, no gate, prior of level"
        f" {LEVEL_SD_DEG:.1f} deg and of heading as stated ({HEADING_SD_DEG[1]:.0f} deg is 180 / sqrt(3));"
        " the invariant errors are those of the whole state on SE_2(3). Within: roll, pitch and heading at"
        f" the end each within {SIGMAS:.0f} standard deviations of the bound. Then RMS at the end; median and"
        f" longest time until heading stays within {HEADING_LIMIT_ARCMIN:.0f} arcmin; processor time of a"
        " run. Ratio: RMS of the reference over ours, with the 95 % interval of runs drawn in pairs."
    )
    return [
        Row(
            f"Any heading, beside the {name}",
            _told(since, ours, limit, cpu_ms["ours"]),
            _told(since, errors, limit, cpu_ms[name]),
            _ratio(errors, ours),
            note="" if k else note,
        )
        for k, (name, errors) in enumerate(theirs.items())
    ]


def records_of(runs: list[Run], step_s: float) -> Records:
    """What the runs' filters were given, in steps of ``step_s``; fixes have no delay and fall on steps."""
    time = runs[0].imu.time
    samples = round(step_s / (time[1] - time[0]))
    imu = (np.array([getattr(run.imu, name) for run in runs]) for name in ("dtheta_b", "dv_b"))
    turn, dv = condensed(*imu, samples)
    time = time[::samples]
    valid = runs[0].fixes.t_valid
    epochs = np.searchsorted(time, valid - 0.1 * step_s)
    assert np.abs(time[epochs] - valid).max() < 1e-6, "fixes do not fall on steps"
    lla, v_n, cov = (np.array([getattr(run.fixes, name) for run in runs]) for name in ("lla", "v_n", "cov"))
    return Records(time, turn, dv, np.array([run.q_nb_coarse for run in runs]), epochs, lla, v_n, cov)


def of_runs(window: Flight, aligned: Aligned) -> Array:
    """Errors (runs, k, 5) of the filters in numpy, as `errors_against` has them."""
    columns = zip(aligned.q_nb, aligned.v_n, aligned.misalignment_cov, strict=True)
    return np.array([errors_against(window, Aligned(aligned.time, *run)) for run in columns])


def _given(run: Run, scenario: Scenario, window: Flight) -> AlignmentInput:
    measured = run.imu.time, run.imu.dtheta_b, run.imu.dv_b, run.q_nb_coarse, run.fixes
    return AlignmentInput.checked(*measured, scenario.alignment.settings, scenario.imu, window.gravity)


def _two_stages(scenario: Scenario, window: Flight, runs: list[Run]) -> list[Estimate]:
    return [estimate("ekf_stamped", _given(run, scenario, window)) for run in runs]


def _coarse_stages(scenario: Scenario, window: Flight, runs: list[Run]) -> list[CoarseAttitude | None]:
    return [align_in_motion(pose(_given(run, scenario, window), DelayModel.STAMPED)) for run in runs]


def _told(since: Array, errors: Array, limit: Array, cpu_ms: float) -> str:
    """A cell of the table, of errors (runs, k, 5) in the units of `score.COLUMNS`."""
    last = errors[np.isfinite(errors[:, -1]).all(axis=1), -1]
    within = int((np.abs(last[:, :3]) < limit).all(axis=1).sum())
    if not len(last):
        return f"0 of {len(errors)} within; {cpu_ms:.0f} ms"
    level, heading = np.sqrt(np.mean(last[:, :2] ** 2)), np.sqrt(np.mean(last[:, 2] ** 2))
    known = np.array([_settled(since, run[:, 2]) for run in errors])
    middle, longest = (f"{t:.1f} s" if np.isfinite(t) else "never" for t in (np.median(known), known.max()))
    return (
        f"{within} of {len(errors)} within; {level:.1f} arcsec, {heading:.2f} arcmin;"
        f" {middle}, {longest}; {cpu_ms:.0f} ms"
    )


def _settled(since: Array, heading: Array) -> float:
    """When heading (k,) comes within the limit to stay; infinite if it never does."""
    outside = np.flatnonzero(~(np.abs(heading) < HEADING_LIMIT_ARCMIN))
    first = outside[-1] + 1 if len(outside) else 0
    return float(since[first]) if first < len(since) else np.inf


def _ratio(theirs: Array, ours: Array) -> str:
    ratios = paired_ratios(theirs[:, -1], ours[:, -1])
    cells = [
        f"{name} {ratios[name][0]:.2f} ({ratios[name][1]:.2f} to {ratios[name][2]:.2f})"
        for name in ("level", "heading")
        if np.isfinite(ratios[name]).all()
    ]
    return ", ".join(cells)
