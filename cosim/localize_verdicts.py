"""What of the paper's localisation is reproduced, by stated rules, and why what is not is not."""

from dataclasses import dataclass

import numpy as np

from ..network.record import Array
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
    why: str

    @property
    def line(self) -> str:
        """In one sentence."""
        return f"{'Reproduced' if self.reproduced else 'Not reproduced'}: {self.statement}. {self.why}"


def figure_2_verdicts(figure: Figure2) -> list[Verdict]:
    """The four printed statements on Fig. 2, and whether one radius gives all."""
    full = [float(row.min()) >= FULL for row in figure.coverage["dmdg"]]
    error = figure.relative["dmdg"][:, RANGING_ERRORS.index(0.05)]
    close = [abs(e / ERROR_AT_5 - 1) <= ERROR_MARGIN for e in error]
    leach = figure.coverage["leach"][:, RANGING_ERRORS.index(0.40)]
    covered = [abs(c - COVERAGE_AT_40) <= COVERAGE_MARGIN for c in leach]
    ratio = (figure.error["leach"] / figure.error["dmdg"])[:, RANGING_ERRORS.index(0.05)]
    fourfold = [abs(r / RATIO - 1) <= RATIO_MARGIN for r in ratio]
    both = [all(parts) for parts in zip(full, close, covered, fourfold, strict=True)]
    least = figure.coverage["dmdg"].min(axis=1)
    return [
        Verdict(
            "DMDG covers all nodes at a message radius of 5 km",
            f"coverage of {100 * FULL:g} % or more at every ranging error",
            full[0],
            f"The least coverage is {_by_radius(least, '{:.1%}')}: at 5 km a node has two others in reach,"
            " and a position takes four.",
        ),
        Verdict(
            "an error of 1.3 % at a ranging error of 5 %",
            f"mean error over mean link within {100 * ERROR_MARGIN:g} % of it, at any radius",
            any(close),
            f"It is {_by_radius(error, '{:.1%}')}.{_fits(close)}",
        ),
        Verdict(
            "LEACH's coverage of 80.32 % at a ranging error of 40 %",
            f"within {100 * COVERAGE_MARGIN:g} points, at any radius",
            any(covered),
            f"It is {_by_radius(leach, '{:.1%}')}.{_fits(covered)}",
        ),
        Verdict(
            "an error under DMDG of about a quarter of LEACH's at a ranging error of 5 %",
            f"ratio within {100 * RATIO_MARGIN:g} % of 4, at any radius",
            any(fourfold),
            f"LEACH's over DMDG's is {_by_radius(ratio, '{:.1f}')}.{_fits(fourfold)} In the mean over ranging"
            f" errors it is {_by_radius(_mean_ratio(figure), '{:.1f}')}. LEACH ranges"
            " between members and heads alone.",
        ),
        Verdict(
            "all four at one radius",
            "a radius at which all four rules hold",
            any(both),
            "No radius gives all of them."
            if not any(both)
            else f"Together at {_radii([r for r, b in zip(RADII_M, both, strict=True) if b])}.",
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
    verdicts = []
    for axis, (name, value) in enumerate(zip("xyz", printed, strict=True)):
        fits = {
            what: abs(ours[axis] / value - 1) <= RMSE_MARGIN
            for what, ours in (("ranges alone", alone), ("with an altitude", high))
        }
        bound, bound_high = figure.bound[axis], figure.bound_with_baro[axis]
        why = (
            f"Ranges alone give {number(alone[axis], 1)} m (bound of one instant {number(bound, 1)} m),"
            f" with an altitude of {BARO_SD_M:g} m {number(high[axis], 1)} m"
            f" (bound {number(bound_high, 1)} m)."
        )
        if value < bound * (1 - RMSE_MARGIN):
            why += (
                f" {value:g} m is below what ranges of {RANGE_SD_M:g} m can tell at one instant in a fleet"
                " eight times as wide as high: it takes another measurement, or an average over time."
            )
        if fits["with an altitude"] and not fits["ranges alone"]:
            why += " With the altitude it fits."
        verdicts.append(
            Verdict(
                f"an RMSE in {name} of {value:g} m",
                f"within {100 * RMSE_MARGIN:g} % of it by ranges alone, without an altitude",
                fits["ranges alone"],
                why,
            )
        )
    shape = [rmse / size for rmse, size in zip(printed, TABLE_2["absolute_m"], strict=True)]
    lengths = [
        size / share / 1000 for size, share in zip(TABLE_2["absolute_m"], TABLE_2["relative"], strict=True)
    ]
    ours = [rmse / size for rmse, size in zip(alone, rows["ranges alone"]["mean_size_m"], strict=True)]
    told = ", ".join(f"{s:.2f}" for s in shape)
    verdicts.append(
        Verdict(
            "absolute errors of 4.0, 6.7 and 4.2 m beside these RMSE",
            "RMSE over mean size within 15 % of a normal error's, 1.25",
            all(abs(s / GAUSSIAN - 1) <= 0.15 for s in shape),
            f"RMSE over absolute error is {told} there and {', '.join(number(s, 2) for s in ours)} here:"
            " theirs is no mean size of a normal error. The relative errors imply lengths of"
            f" {', '.join(f'{x:.1f}' for x in lengths)} km, ours are over the mean link of"
            f" {number(figure.range / 1000, 1)} km.",
        )
    )
    return verdicts


def _by_radius(values: Array, form: str) -> str:
    told = [form.format(v).replace("%", " %") if np.isfinite(v) else "undefined" for v in values]
    parts = [f"{value} at {radius / 1000:g} km" for value, radius in zip(told, RADII_M, strict=True)]
    return ", ".join(parts)


def _fits(fitting: list[bool]) -> str:
    radii = [radius for radius, fits in zip(RADII_M, fitting, strict=True) if fits]
    return f" It fits at {_radii(radii)}." if radii else ""


def _radii(radii: list[float]) -> str:
    return " and ".join(f"{radius / 1000:g} km" for radius in radii)
