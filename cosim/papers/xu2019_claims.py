"""What Xu, Wang and Chen say of their methods, claim by claim, each judged by a rule."""

import numpy as np

from . import statistics
from .judging import Held, above, below, both, verdict, within
from .results import Array, Claim, Table, Value, Verdict
from .xu2019_runs import Outcome, Shown
from .xu2019_settings import MovingAnchor

Found = dict[float, dict[str, Outcome]]
CLEARLY, NEAR, MOST, FEWER = 0.9, 1.05, 0.95, 1.10
FEW_PERCENT, CONSISTENT = 1.0, (1.5, 2.5)
"""Of nodes that single precision may put off; and NEES of a CKF in double precision that is a reference."""
_EACH = ": at each radius reproduced, at one of them partly, at none not"


def claims(
    settings: MovingAnchor, found: Found, runs: dict[float, Shown], aside: tuple[Table, ...]
) -> tuple[Claim, ...]:
    """All of them, in the paper's order. ``aside`` are the tables of `xu2019_studies`."""
    tables = {table.name: table for table in aside}
    return (
        _linear(found),
        _overhead(tables["heights"]),
        _threshold(found),
        _time(settings, found),
        _ckf(found),
        _square_root(found),
        _figure_8(runs),
        _definite(tables["single_precision"]),
    )


def ratios(found: Found, key: str, over: str) -> dict[float, Value]:
    """RMSE of one method over another's, by radius."""
    return {
        radius: statistics.rms_ratio(by[key].squares.mean(axis=1), by[over].squares.mean(axis=1))
        for radius, by in found.items()
    }


def _told(values: dict[float, Value], digits: int = 2) -> str:
    parts = []
    for radius, v in values.items():
        interval = f" ({v.low:.{digits}f} to {v.high:.{digits}f})" if np.isfinite(v.low) else ""
        parts.append(f"{v.value:.{digits}f}{interval} at {radius:g} m")
    return ", ".join(parts)


def _below(values: dict[float, Value], limit: float) -> Verdict:
    """Whether figures are below a limit at all radii, or at one."""
    held = [below(v, limit) for v in values.values()]
    return verdict(both(*held), held)


def _linear(found: Found) -> Claim:
    over, mended = ratios(found, "linear", "bound"), ratios(found, "linear_weighted", "bound")
    return Claim(
        "1.2, (2) to (4)",
        "The linear solution is the maximum likelihood estimate.",
        f"RMSE over the bound below {NEAR:g}{_EACH}",
        _below(over, NEAR),
        f"RMSE over the bound {_told(over)}; with weights, about their mean, {_told(mended)}.",
        "Each equation has the error of the last range in it, the longest one; and squares of long ranges,"
        " the worst, count like those of short ones.",
    )


def _overhead(heights: Table) -> Claim:
    printed, known, estimated = (row.values for row in heights.rows[:3])
    over = {0.0: printed["over_known"]}
    return Claim(
        "1.2, abstract",
        "The height of a node is known from the range overhead, z0 = z1 - l3, and so its place in space.",
        f"horizontal RMSE over the bound of known heights below {NEAR:g}: reproduced, else not",
        _below(over, NEAR),
        f"RMSE over that bound {printed['over_known'].value:.2f}, with known heights"
        f" {known['over_known'].value:.2f}, heights estimated {estimated['over_known'].value:.2f}; height to"
        f" {printed['height_rmse_m'].value:.2f} m, estimated {estimated['height_rmse_m'].value:.2f} m.",
        "The UAV seldom passes overhead, and the shortest of many ranges is also the one whose error is the"
        " most negative.",
    )


def _threshold(found: Found) -> Claim:
    over, size = ratios(found, "srckf_printed", "srckf_wide"), ratios(found, "srckf_size", "srckf")
    return Claim(
        "2.2, Fig. 7",
        "The threshold on the deviations of (6) improves accuracy and reliability.",
        f"RMSE with it over RMSE without it below 1{_EACH}",
        _below(over, 1.0),
        f"With it over without it {_told(over)}; on |D_j| {_told(size)}.",
        "D_j < alpha takes every negative deviation, one of each pair of points: the covariance halves at"
        " each beacon, and the filter stays at its linear start. On |D_j| it stops where it comes to alpha.",
    )


def _time(settings: MovingAnchor, found: Found) -> Claim:
    over = ratios(found, "srckf_information", "srckf")
    printed = {radius: statistics.mean(_used(by["srckf_printed"])) for radius, by in found.items()}
    share = {
        radius: statistics.mean_ratio(_used(by["srckf_information"]), _used(by["srckf"]))
        for radius, by in found.items()
    }
    good = [both(below(over[radius], FEWER), below(share[radius], MOST)) for radius in found]
    fewer = both(*(below(value, MOST) for value in printed.values()))
    return Claim(
        "2.2",
        "The threshold shortens the computation.",
        f"as printed fewer than {100 * MOST:g} % of the updates at each radius: reproduced; else, by another"
        f" threshold fewer than that at less than {100 * (FEWER - 1):.0f} % more error at some radius:"
        " partly; neither: not",
        verdict(fewer, good),
        f"Share of updates that are made: as printed {_told(printed)}. If ranges whose predicted deviation"
        f" is below {settings.threshold_share:g} of their noise are left out, {_told(share)}; RMSE over that"
        f" of all {_told(over)}.",
        "Zeros in a matrix of fixed size save nothing; ranges that are left out do.",
    )


def _used(outcome: Outcome) -> Array:
    """(draws,) means over nodes."""
    assert outcome.used is not None
    return outcome.used.mean(axis=1)


def _ckf(found: Found) -> Claim:
    over = ratios(found, "ckf_wide", "linear")
    return Claim(
        "3.1, Figs. 4 and 6",
        "The CKF is clearly more accurate than maximum likelihood.",
        f"RMSE over that of the linear solution below {CLEARLY:g}{_EACH}",
        _below(over, CLEARLY),
        f"{_told(over)}; over the bound {_told(ratios(found, 'ckf_wide', 'bound'))}, least squares"
        f" {_told(ratios(found, 'quasi', 'bound'))}.",
        "The linear solution lacks weights, which filters have, and least squares has them as well.",
    )


def _square_root(found: Found) -> Claim:
    over = ratios(found, "srckf_wide", "ckf_wide")
    return Claim(
        "3.1, Figs. 4 and 7",
        "The SR-CKF is more accurate than the CKF.",
        f"RMSE without the threshold over that of the CKF below 1 by more than 0.1 %{_EACH}",
        _below(over, 0.999),
        f"{_told(over, 6)}.",
        "A square root changes how the covariance is stored, not the estimate.",
    )


def _figure_8(runs: dict[float, Shown]) -> Claim:
    first, second = {}, {}
    for radius, shown in runs.items():
        mse = {key: np.sum(e**2, axis=-1).mean(axis=1) for key, e in shown.errors.items()}
        first[radius] = statistics.mean(100.0 * (mse["srckf_printed"] < mse["ckf_wide"]))
        second[radius] = statistics.mean(100.0 * (mse["ckf_wide"] < mse["linear"]))
    held = [both(*(above(v, 100 * MOST) for v in share.values())) for share in (first, second)]
    told = [", ".join(f"{v.value:.0f} % at {r:g} m" for r, v in share.items()) for share in (first, second)]
    return Claim(
        "3.3, Fig. 8",
        "In all runs the SR-CKF's mean squared error is below the CKF's, and that below MLE's.",
        f"each in more than {100 * MOST:g} % of the runs at each radius: reproduced; one of them: partly;"
        " neither: not",
        verdict(both(*held), held),
        f"SR-CKF with threshold below CKF in {told[0]} of the runs; CKF below MLE in {told[1]}.",
        "A square root changes no estimate: what differs is the threshold, and the weights that MLE lacks.",
    )


def _definite(table: Table) -> Claim:
    plain, rooted = table.rows[0::2], table.rows[1::2]
    held = [_rescued(p.values, r.values) for p, r in zip(plain, rooted, strict=True)]
    told = "; ".join(
        f"{p.method.split(', ')[1]} {p.values['off_single_percent'].value:.0f} % and"
        f" {r.values['off_single_percent'].value:.0f} %"
        for p, r in zip(plain, rooted, strict=True)
    )
    apart = [row.values["condition_log10"].value for row in (plain[0], plain[-1])]
    return Claim(
        "4",
        "The square root ensures a positive definite covariance, and numerical robustness.",
        f"from starts that are flat, in single precision the CKF loses or puts off more than"
        f" {FEW_PERCENT:g} % of the nodes and the SR-CKF fewer, where the CKF in double precision has"
        f" a NEES of {CONSISTENT[0]:g} to {CONSISTENT[1]:g}: at the stated errors reproduced, in another row"
        " alone partly, in none not",
        verdict(held[0], held[1:]),
        f"Lost or off by half a standard deviation, CKF and SR-CKF: {told}.",
        f"Variances are 10^{apart[0]:.1f} apart at the stated errors, 10^{apart[1]:.1f} along a line; single"
        " precision holds seven decades. Rounding of positions and ranges themselves no square root mends.",
    )


def _rescued(plain: dict[str, Value], rooted: dict[str, Value]) -> Held:
    """Whether the square root keeps in single precision what the plain form does not."""
    return both(
        above(plain["off_single_percent"], FEW_PERCENT),
        below(rooted["off_single_percent"], FEW_PERCENT),
        within(plain["nees_double"], *CONSISTENT),
    )
