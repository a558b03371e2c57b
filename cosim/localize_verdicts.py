"""What of the paper's localisation is reproduced, by stated rules, and why what is not is not."""

from dataclasses import dataclass

import numpy as np

from ..network.record import Array, Booleans
from .localize_flight import BARO_SD_M, RANGE_SD_M, Figure3, table_2
from .localize_paper import RADII_M, RANGING_ERRORS, Figure2
from .pages import number

FULL = 0.995
"""Coverage that counts as full."""
COVERAGE_AT_40, COVERAGE_MARGIN = 0.8032, 0.05
ERROR_AT_5, ERROR_MARGIN = 0.013, 0.25
RATIO, RATIO_MARGIN = 4.0, 0.25
TABLE_2 = {
    "relative": (0.00124, 0.00263, 0.00147),
    "absolute_m": (4.041, 6.682, 4.199),
    "rmse_m": (9.761, 13.254, 10.675),
}
"""Gao et al., Table 2: x, y, z."""
RMSE_MARGIN = 0.25
GAUSSIAN = float(np.sqrt(np.pi / 2))
"""RMSE over mean size of a normal deviate."""


@dataclass(frozen=True)
class Verdict:
    """One statement of the paper beside ours."""

    statement: str
    rule: str
    reproduced: bool
    where: str
    """At what setting it is, or is not: "at 50 km alone"."""
    why: str

    @property
    def line(self) -> str:
        """In one sentence."""
        judged = "Reproduced" if self.reproduced else "Not reproduced"
        return f"{judged} {self.where}: {self.statement}. {self.why}"


def figure_2_verdicts(figure: Figure2) -> list[Verdict]:
    """The four printed statements on Fig. 2, and whether one radius gives all."""
    least = figure.coverage["dmdg"].min(axis=1)
    error = figure.relative["dmdg"][:, RANGING_ERRORS.index(0.05)]
    leach = figure.coverage["leach"][:, RANGING_ERRORS.index(0.40)]
    ratio = (figure.error["leach"] / figure.error["dmdg"])[:, RANGING_ERRORS.index(0.05)]
    fits = {
        "DMDG's coverage": least >= FULL,
        "DMDG's error": np.abs(error / ERROR_AT_5 - 1) <= ERROR_MARGIN,
        "LEACH's coverage": np.abs(leach - COVERAGE_AT_40) <= COVERAGE_MARGIN,
        "The ratio of errors": np.abs(ratio / RATIO - 1) <= RATIO_MARGIN,
    }
    full, close, covered, fourfold = fits.values()
    all_ = full & close & covered & fourfold
    return [
        Verdict(
            "DMDG covers all nodes at a message radius of 5 km",
            f"coverage of {100 * FULL:g} % or more at every ranging error",
            bool(full[0]),
            "at 5 km",
            f"The least coverage is {_by_radius(least, '{:.1%}', _points(least, 1.0))}. At 5 km a node has"
            " two others in reach, and a position takes four.",
        ),
        Verdict(
            "an error of 1.3 % at a ranging error of 5 %",
            f"mean error over mean link within {100 * ERROR_MARGIN:g} % of it, at any radius",
            bool(close.any()),
            _where(close),
            f"It is {_by_radius(error, '{:.1%}', _relative(error, ERROR_AT_5))}.",
        ),
        Verdict(
            "LEACH's coverage of 80.32 % at a ranging error of 40 %",
            f"within {100 * COVERAGE_MARGIN:g} points, at any radius",
            bool(covered.any()),
            _where(covered),
            f"It is {_by_radius(leach, '{:.1%}', _points(leach, COVERAGE_AT_40))}.",
        ),
        Verdict(
            "an error under DMDG of about a quarter of LEACH's at a ranging error of 5 %",
            f"ratio within {100 * RATIO_MARGIN:g} % of 4, at any radius",
            bool(fourfold.any()),
            _where(fourfold),
            f"LEACH's over DMDG's is {_by_radius(ratio, '{:.1f}', _relative(ratio, RATIO))}. In the mean over"
            f" ranging errors it is {_by_radius(_mean_ratio(figure), '{:.1f}')}. LEACH ranges"
            " between members and heads alone.",
        ),
        Verdict(
            "all four together",
            "a radius at which all four rules hold",
            bool(all_.any()),
            _where(all_),
            " ".join(f"{name} fits {_where(held, nowhere='no')}." for name, held in fits.items()),
        ),
    ]


def _mean_ratio(figure: Figure2) -> Array:
    """LEACH's error over DMDG's, (radii,), mean over ranging errors; NaN where one covers no node."""
    ratio = figure.error["leach"] / figure.error["dmdg"]
    known = np.isfinite(ratio)
    total = np.where(known, ratio, 0.0).sum(axis=1)
    return total / np.where(known.any(axis=1), known.sum(axis=1), np.nan)


def figure_3_verdicts(figure: Figure3) -> list[Verdict]:
    """Table 2: each axis by ranges alone and with an altitude, and what its own figures say of each other."""
    rows = table_2(figure)
    alone, high = rows["ranges alone"]["rmse_m"], rows["ranges and altitude"]["rmse_m"]
    printed = TABLE_2["rmse_m"]
    setting = f"on one fleet with links to {figure.link_radius / 1000:g} km"
    verdicts = []
    for axis, (name, value) in enumerate(zip("xyz", printed, strict=True)):
        off, off_high = alone[axis] / value - 1, high[axis] / value - 1
        fits, fits_high = abs(off) <= RMSE_MARGIN, abs(off_high) <= RMSE_MARGIN
        bound, bound_high = figure.bound[axis], figure.bound_with_baro[axis]
        why = (
            f"Ranges alone give {number(alone[axis], 1)} m ({_signed(off)}; bound of one instant"
            f" {number(bound, 1)} m), with an altitude of {BARO_SD_M:g} m {number(high[axis], 1)} m"
            f" ({_signed(off_high)}; bound {number(bound_high, 1)} m)."
        )
        if value < bound * (1 - RMSE_MARGIN):
            why += (
                f" {value:g} m is below what ranges of {RANGE_SD_M:g} m can tell at one instant in a fleet"
                " eight times as wide as high: it takes another measurement, or an average over time."
            )
        if fits_high and not fits:
            why += " With the altitude it fits."
        verdicts.append(
            Verdict(
                f"an RMSE in {name} of {value:g} m",
                f"within {100 * RMSE_MARGIN:g} % of it by ranges alone, without an altitude",
                bool(fits),
                f"by ranges alone, {setting}",
                why,
            )
        )
    shape = [rmse / size for rmse, size in zip(printed, TABLE_2["absolute_m"], strict=True)]
    lengths = [
        size / share / 1000 for size, share in zip(TABLE_2["absolute_m"], TABLE_2["relative"], strict=True)
    ]
    ours = [rmse / size for rmse, size in zip(alone, rows["ranges alone"]["mean_size_m"], strict=True)]
    beside = [f"{number(o, 2)} ({_signed(o / s - 1)})" for o, s in zip(ours, shape, strict=True)]
    normal = [abs(s / GAUSSIAN - 1) <= 0.15 for s in shape]
    verdicts.append(
        Verdict(
            "absolute errors of 4.0, 6.7 and 4.2 m beside these RMSE",
            "RMSE over mean size within 15 % of a normal error's, 1.25",
            all(normal),
            "on any axis" if not any(normal) else "on all axes together",
            f"RMSE over absolute error is {', '.join(f'{s:.2f}' for s in shape)} there and"
            f" {', '.join(beside)} here: theirs is no mean size of a normal error. The relative"
            f" errors imply lengths of {', '.join(f'{x:.1f}' for x in lengths)} km, ours are over the mean"
            f" link of {number(figure.range / 1000, 1)} km.",
        )
    )
    return verdicts


def _by_radius(values: Array, form: str, off: list[str] | None = None) -> str:
    """The values at each radius, with what they are off the paper's behind where that is given."""
    told = [form.format(v).replace("%", " %") if np.isfinite(v) else "undefined" for v in values]
    behind = [f" ({o})" if o else "" for o in off or [""] * len(values)]
    parts = [f"{v} at {r / 1000:g} km{b}" for v, r, b in zip(told, RADII_M, behind, strict=True)]
    return ", ".join(parts)


def _relative(values: Array, printed: float) -> list[str]:
    return [_signed(v / printed - 1) for v in values]


def _points(shares: Array, printed: float) -> list[str]:
    return [f"{100 * (share - printed):+.1f} points" for share in shares]


def _signed(share: float) -> str:
    """A deviation in percent with its sign; nothing where there is none to tell."""
    if not np.isfinite(share):
        return ""
    return f"{100 * share:+.1f} %" if abs(share) < 1 else f"{100 * share:+.0f} %"


def _where(fitting: Booleans, nowhere: str = "any") -> str:
    """The radii that fit, and "at any radius" after "not reproduced" where there are none."""
    radii = [f"{radius / 1000:g} km" for radius, fits in zip(RADII_M, fitting, strict=True) if fits]
    if not radii:
        return f"at {nowhere} radius"
    return "at every radius" if all(fitting) else f"at {' and '.join(radii)} alone"
