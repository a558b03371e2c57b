"""What Wan et al. claim, each by a rule that is said before the numbers."""

from itertools import pairwise

import numpy as np

from . import judging, statistics
from .judging import Held, above, below, both
from .results import Array, Claim, Value, Verdict
from .wan2008_costs import Costs
from .wan2008_runs import ASTRAY, ERROR, TO_THE_END, Cell, elements_cell, quoted_cells, sweep_cell
from .wan2008_settings import Refinement

Found = dict[Cell, dict[str, Array]]
_POINTS = (15.0, 5.0, 5.0)
"""That the paper quotes, at `quoted_cells`."""
_NEAR = 0.15
"""Of an exponent."""
_MOST_LOST = 1.0
"""Per cent of the nodes up to which a filter does not diverge."""


def claims(settings: Refinement, found: Found, counted: Costs) -> tuple[Claim, ...]:
    """All of them, in the paper's order."""
    return (
        _stable(settings, found),
        _growth(counted),
        _messages(counted),
        _equal(settings, found),
        _density(settings, found),
        _saturation(settings, found),
        _refined(settings, found),
        *(_gain(found, cell, points) for cell, points in zip(quoted_cells(settings), _POINTS, strict=True)),
        _where_most(settings, found),
        _figure_5(settings, [found[sweep_cell(settings, e)] for e in settings.range_error_shares]),
    )


def _points(at: dict[str, Array], method: str, other: str = "dv") -> Array:
    """By how many points the error of ``other`` is higher, of each draw."""
    return 100 * (at[other][:, ERROR] - at[method][:, ERROR])


def _better(at: dict[str, Array], method: str) -> Held:
    return above(statistics.mean(_points(at, method)), 0)


def _error(at: dict[str, Array], method: str) -> float:
    """Mean, % of the radius."""
    return float(100 * np.nanmean(at[method][:, ERROR]))


def _judged(held: list[Held]) -> Verdict:
    """Reproduced if it holds everywhere, partly if it fails somewhere and holds somewhere."""
    return judging.verdict(both(*held), held)


def _count(held: list[Held]) -> str:
    return f"{held.count(Held.YES)} of {len(held)}"


def _told(value: Value, digits: int = 1) -> str:
    if not np.isfinite(value.low):
        return f"{value.value:.{digits}f}"
    return f"{value.value:.{digits}f} ({value.low:.{digits}f} to {value.high:.{digits}f})"


def _stable(settings: Refinement, found: Found) -> Claim:
    at = found[elements_cell(settings)]
    lost = {key: 100 * at[key][:, ASTRAY] for key in at}
    mean = {key: float(values.mean()) for key, values in lost.items()}
    printed = below(statistics.mean(lost["distributed_printed"]), _MOST_LOST)
    saves = above(statistics.mean(lost["cap_1"] - lost["cap_none"]), 0)
    return Claim(
        where="section 1.2, (8) to (13)",
        statement="The fading factor keeps the filter from diverging.",
        rule=f"Of the filter as printed less than {_MOST_LOST:g} % of the nodes are lost, off by more than"
        " ten radii: reproduced; otherwise, fewer of the mended one with the factor as printed, without a"
        " limit, than without fading: partly.",
        verdict=judging.verdict(printed, [saves]),
        measured=f"Lost as printed {mean['distributed_printed']:.1f} %. Mended: without fading"
        f" {mean['cap_1']:.2f} %, lambda <= {settings.max_fading:g} {mean['distributed']:.2f} %, <= 1e4"
        f" {mean['cap_1e4']:.2f} %, without limit {mean['cap_none']:.2f} %, in {np.sum(lost['cap_none'] > 0)}"
        f" of {len(lost['cap_none'])} draws. Mended, but neighbours taken for"
        f" beacons: lambda <= {settings.max_fading:g} {mean['known']:.2f} %, <= 1e4"
        f" {mean['known_cap_1e4']:.2f} %, without limit {mean['known_cap_none']:.2f} %.",
        why="The rows of the table of elements differ from the mended filter in what they name. Without a"
        " limit a node that is thrown far out starts from there; which nodes are is decided by rounding.",
    )


def _growth(counted: Costs) -> Claim:
    e = counted.exponents
    measure = abs(e["h_dense"] - 2) < _NEAR and abs(e["h_distributed"] - 1) < _NEAR
    work = all(abs(e[k] - b) < _NEAR for k, b in (("dense", 2), ("sparse", 2), ("distributed", 1)))
    held = [Held.YES if holds else Held.NO for holds in (measure, work)]
    return Claim(
        where="2.2.3, conclusion (a)",
        statement="The computation grows linearly with the nodes when distributed, by their square when"
        " central.",
        rule="Exponents within 0.15 of 1 and 2: of the multiplications, dense and sparse, and of the entries"
        " of H, which the paper takes for the computation: reproduced; of one of the two: partly. Counts, in"
        " one network of each size.",
        verdict=_judged(held),
        measured=f"Entries of H: central {e['h_dense']:.2f}, distributed {e['h_distributed']:.2f}."
        f" Multiplications a step: central dense {e['dense']:.2f}, sparse {e['sparse']:.2f}, distributed"
        f" {e['distributed']:.2f}.",
        why="Entries of a dense H are counted in the paper, of which all but four in a row are zero. The"
        " sparse form is another filter than the printed one: it has no Q, and puts back as at the start what"
        " fading forgets.",
    )


def _messages(counted: Costs) -> Claim:
    c, n = counted.counts, counted.nodes
    every = bool((c["messages_distributed"] < c["messages_step"]).all())
    once = bool((c["messages_distributed"] < c["messages_once"]).all())
    fewer = n[c["messages_distributed"] < c["messages_once"]]
    return Claim(
        where="2.2.4",
        statement="The distributed form needs fewer messages than the central one.",
        rule="For the most steps there may be, or until its stop rule ends a form, fewer at all sizes"
        " than once to the sink and back:"
        " reproduced; than to the sink and back at every step, as the paper has it: partly. Counts, in one"
        " network of each size.",
        verdict=judging.verdict(Held.YES if once else Held.NO, [Held.YES if every else Held.NO]),
        measured=f"At {n[-1]:.0f} nodes: distributed {c['messages_distributed'][-1]:.0f} in"
        f" {c['steps_distributed'][-1]:.0f} sweeps, central every step {c['messages_step'][-1]:.0f} in"
        f" {c['steps_central'][-1]:.0f} steps, central once {c['messages_once'][-1]:.0f}. Fewer than every"
        f" step at {int((c['messages_distributed'] < c['messages_step']).sum())} of {len(n)} sizes, than once"
        f" at {f'{len(fewer)} of {len(n)}' if len(fewer) else 'none'}.",
        why="A sink needs the ranges once, not at every step; all nodes broadcast in each sweep.",
    )


def _equal(settings: Refinement, found: Found) -> Claim:
    cells = quoted_cells(settings)
    ratios = [
        statistics.mean_ratio(found[c]["distributed_long"][:, ERROR], found[c]["central_long"][:, ERROR])
        for c in cells
    ]
    short = found[elements_cell(settings)]
    stopped = statistics.mean_ratio(short["distributed"][:, ERROR], short["central"][:, ERROR])
    return Claim(
        where="2.2.3",
        statement="Distributed and central forms are equally accurate.",
        rule="Mean error of the distributed over that of the central form, both mended, until their own"
        f" stop rule ends them or {TO_THE_END * settings.max_steps} steps: the 95 % interval below 1.1 at all"
        " points that the paper quotes: reproduced;"
        " below at some, and above at others: partly; above at all: not.",
        verdict=_judged([below(value, 1.1) for value in ratios]),
        measured="; ".join(
            f"connectivity {c.connectivity:g}, {100 * c.share:g} %: {_told(v, 2)}"
            for c, v in zip(cells, ratios, strict=True)
        )
        + f". After {settings.max_steps} steps, at the first of these: {_told(stopped, 2)}.",
        why="Errors that many nodes share, as DV-distance leaves them, take many sweeps.",
    )


def _density(settings: Refinement, found: Found) -> Claim:
    degrees, low = settings.connectivities, settings.low_share
    held: list[Held] = []
    for share in settings.beacon_shares:
        rows = [100 * found[Cell(d, share)]["dv"][:, ERROR] for d in degrees]
        steps = pairwise(rows)
        held.append(both(*(above(statistics.mean(a - b), 0) for a, b in steps)))
    return Claim(
        where="section 3, Fig. 3",
        statement="At any share of beacons the error of DV-distance falls as the connectivity grows.",
        rule="The 95 % interval of the fall from each connectivity to the next is above zero: at all shares"
        " reproduced, at some partly.",
        verdict=_judged(held),
        measured=f"It falls at {_count(held)} shares. At {100 * low:g} %: "
        + ", ".join(f"{_error(found[Cell(d, low)], 'dv'):.0f}" for d in degrees)
        + " % of the radius.",
        why="Paths through more nodes bend less.",
    )


def _saturation(settings: Refinement, found: Found) -> Claim:
    low, high = settings.low_share, settings.high_share
    middle = min((s for s in settings.beacon_shares if low < s < high), key=lambda s: abs(s - 0.3))
    held: list[Held] = []
    told: list[str] = []
    for degree in settings.connectivities:
        few, some, many = (100 * found[Cell(degree, s)]["dv"][:, ERROR] for s in (low, middle, high))
        held.append(below(statistics.mean(some - many - 0.1 * (few - some)), 0))
        means = ", ".join(f"{values.mean():.0f}" for values in (few, some, many))
        told.append(f"connectivity {degree:g}: {means} %")
    return Claim(
        where="section 3, Fig. 3",
        statement="Beyond 30 % of beacons the error hardly changes.",
        rule=f"DV-distance falls from {100 * middle:g} to {100 * high:g} % of beacons by less than a tenth of"
        f" what it falls from {100 * low:g} to {100 * middle:g} %, with the 95 % interval: at all"
        " connectivities reproduced, at some partly.",
        verdict=_judged(held),
        measured=f"At {100 * low:g}, {100 * middle:g}, {100 * high:g} %: " + "; ".join(told) + ".",
        why="With more beacons more nodes hear three of them themselves, and have no error then.",
    )


def _refined(settings: Refinement, found: Found) -> Claim:
    exact = [at for cell, at in found.items() if cell.error == 0]
    mended = [_better(at, "distributed") for at in exact]
    sage = [_better(at, "distributed_sage") for at in exact if "distributed_sage" in at]
    printed = [_better(at, "distributed_printed") for at in exact if "distributed_printed" in at]
    at = found[elements_cell(settings)]
    forms = (
        ("mended", "distributed"),
        ("without fading", "cap_1"),
        ("with Sage's noise", "distributed_sage"),
        ("with neighbours taken for beacons", "known"),
    )
    return Claim(
        where="abstract, Fig. 3",
        statement="Refinement by the filter reduces the error of DV-distance.",
        rule="Lower with the 95 % interval: at all points where it was run as printed: reproduced; mended, at"
        " all points: partly.",
        verdict=judging.verdict(both(*printed, *mended), [both(*mended)]),
        measured=f"Lower at {_count(mended)} points mended (fixed Q and R), {_count(sage)} mended with Sage's"
        f" noise, {_count(printed)} as printed. From {_error(at, 'dv'):.1f} % of the radius: "
        + ", ".join(f"{name} {_error(at, key):.1f}" for name, key in forms)
        + ".",
        why="Of the mended filter lambda is limited and Q and R are fixed: what gains is refinement on the"
        " ranges, and that a neighbour's covariance counts. It is no verdict on fading, nor on Sage's noise.",
    )


def _gain(found: Found, cell: Cell, points: float) -> Claim:
    at = found[cell]
    value = statistics.mean(_points(at, "distributed"))
    return Claim(
        where="section 3",
        statement=f"At connectivity {cell.connectivity:g} and {100 * cell.share:g} % beacons the error falls"
        f" by about {points:g} points.",
        rule=f"The 95 % interval of the mended filter's gain lies within {points / 1.5:.1f} to"
        f" {1.5 * points:.1f} points: reproduced; outside, and above zero: partly.",
        verdict=judging.verdict(judging.within(value, points / 1.5, 1.5 * points), [above(value, 0)]),
        measured=f"{_told(value)} points, from {_error(at, 'dv'):.0f} to {_error(at, 'distributed'):.0f} % of"
        f" the radius; Sage's noise {_told(statistics.mean(_points(at, 'distributed_sage')))} points.",
        why="It depends on how far off DV-distance is, which the number of beacons that a node is located by"
        " decides; the paper does not state it. Q and R are fixed.",
    )


def _where_most(settings: Refinement, found: Found) -> Claim:
    cells = quoted_cells(settings)
    few, many, dense = (_points(found[cell], "distributed") for cell in cells)
    return Claim(
        where="section 3, conclusion (b)",
        statement="The gain is largest at low connectivity and few beacons.",
        rule="In points, of the mended filter, with the 95 % interval of the difference: larger at the low"
        " share than at the high one, and at the second connectivity than at the last: reproduced; one of"
        " them: partly.",
        verdict=_judged([above(statistics.mean(few - other), 0) for other in (many, dense)]),
        measured=f"{few.mean():.0f} points, against {many.mean():.0f} with more beacons and"
        f" {dense.mean():.0f} at connectivity {cells[2].connectivity:g}.",
        why="In shares of DV-distance's error it may be the other way round.",
    )


def _figure_5(settings: Refinement, sweep: list[dict[str, Array]]) -> Claim:
    grows = above(statistics.mean(100 * (sweep[-1]["dv"][:, ERROR] - sweep[0]["dv"][:, ERROR])), 0)
    better = both(*(_better(at, "distributed") for at in sweep))
    return Claim(
        where="section 3, Fig. 5",
        statement="The error grows with the ranging error, and refinement reduces it at every one.",
        rule="Mended, lower at all ranging errors with the 95 % interval, and DV-distance worse at the"
        " largest than at the least: reproduced; one of them: partly.",
        verdict=_judged([better, grows]),
        measured=", ".join(
            f"{100 * e:g} %: {_error(at, 'dv'):.0f} to {_error(at, 'distributed'):.0f}"
            for e, at in zip(settings.range_error_shares, sweep, strict=True)
        )
        + " % of the radius.",
        why="The bend of the paths is far more than the ranging error. Q and R are fixed.",
    )
