"""The rules by which the claims of Wan et al. are judged, on outcomes that are made up."""

import numpy as np
import pytest
from fleetalign.cosim.papers.results import Verdict
from fleetalign.cosim.papers.wan2008_claims import claims
from fleetalign.cosim.papers.wan2008_costs import Costs
from fleetalign.cosim.papers.wan2008_runs import (
    ASTRAY,
    ERROR,
    Cell,
    cells_of,
    elements_cell,
    quoted_cells,
    sweep_cell,
)
from fleetalign.cosim.papers.wan2008_settings import Refinement

SETTINGS = Refinement.model_validate({"kind": "refinement"})
CLAIMS = [
    "stable", "growth", "messages", "equal", "density", "saturation",
    "refined", "gain_1", "gain_2", "gain_3", "where_most", "figure_5",
]  # fmt: skip
YES, PARTLY, NOT, OPEN = Verdict.REPRODUCED, Verdict.PARTLY, Verdict.NOT, Verdict.UNDECIDED
DRAWS = 40
# Common to all methods, so that differences have hardly any spread unless a test gives them one.
NOISE = np.random.default_rng(0).uniform(0.98, 1.02, DRAWS)
# Mean 1: so much noise that no interval of a difference says anything.
WIDE = np.random.default_rng(1).permutation(np.repeat([-8.0, 28.0], [30, 10]))
FIRST, MANY, DENSE = quoted_cells(SETTINGS)
SWEEP = [sweep_cell(SETTINGS, error) for error in SETTINGS.range_error_shares]
GRID = [Cell(d, share) for d in SETTINGS.connectivities for share in SETTINGS.beacon_shares]
METHODS = [
    "distributed", "distributed_printed", "distributed_sage", "distributed_long", "central", "central_long",
    "cap_1", "cap_1e4", "cap_none", "known", "known_cap_1e4", "known_cap_none",
]  # fmt: skip


def outcome(error, lost=0.0, spread=NOISE):
    """Of an error in radii and a share of nodes lost."""
    rows = np.full((len(spread), 6), np.nan)
    rows[:, ERROR], rows[:, ASTRAY] = error * spread, lost * spread
    return rows


def start(cell):
    """DV-distance as the paper has it: worse at few beacons, low connectivity, large ranging errors."""
    by_share = dict(zip(SETTINGS.beacon_shares, (1.2, 1.0, 0.7, 0.4, 0.36), strict=True))
    return (1 - 0.05 * (cell.connectivity - 6)) * by_share[cell.share] + cell.error


def judged(claim, changes, counted=None, draws=DRAWS):
    """The verdict with (cell, method) changed."""
    found = {}
    for cell in cells_of(SETTINGS):
        gain = {FIRST: 0.15, MANY: 0.05, DENSE: 0.05}.get(cell, 0.02)
        found[cell] = {"dv": outcome(start(cell))}
        found[cell] |= {method: outcome(start(cell) - gain) for method in METHODS}
    for (cell, method), made in changes.items():
        found[cell][method] = made
    few = {cell: {key: rows[:draws] for key, rows in at.items()} for cell, at in found.items()}
    return claims(SETTINGS, few, counted or costs())[CLAIMS.index(claim)].verdict


def costs(exponents=(), **counts):
    told = {"h_dense": 2.0, "h_distributed": 1.0, "dense": 2.0, "sparse": 2.0, "distributed": 1.0}
    kinds = ("messages_distributed", "messages_step", "messages_once", "steps_central", "steps_distributed")
    each = {kind: np.full(3, float(level)) for level, kind in enumerate(kinds)}
    each |= {kind: np.asarray(values, float) for kind, values in counts.items()}
    return Costs(np.array([50.0, 100.0, 200.0]), each, told | dict(exponents))


def over(cells, method, made):
    return {(cell, method): made(cell) for cell in cells}


def element(**lost):
    return {(elements_cell(SETTINGS), key): outcome(0.5, share) for key, share in lost.items()}


def worse(cell):
    return outcome(start(cell) + 0.01)


def wide(cell):
    return outcome(start(cell), spread=WIDE)


def level(value):
    return lambda cell: outcome(value)


def forms(*ratios):
    """Of both forms at their end, at the cells that the paper quotes."""
    made = {(cell, "central_long"): outcome(1.0) for cell in (FIRST, MANY, DENSE)}
    rows = zip((FIRST, MANY, DENSE), ratios, strict=True)
    return made | {(cell, "distributed_long"): outcome(ratio, spread=NOISE[::-1]) for cell, ratio in rows}


SAME_SHARE = [cell for cell in GRID if cell.share == SETTINGS.low_share]
HALF = [cell for cell in GRID if cell.share == SETTINGS.high_share]


@pytest.mark.parametrize(
    ("claim", "changes", "verdict"),
    [
        ("stable", {}, YES),
        ("stable", element(distributed_printed=0.009), YES),
        ("stable", element(distributed_printed=0.5, cap_1=0.2, cap_none=0.1), PARTLY),
        ("stable", element(distributed_printed=0.5), NOT),
        ("stable", element(distributed_printed=0.5, cap_none=0.004), NOT),
        ("stable", element(distributed_printed=0.5, cap_1e4=0.0, cap_1=0.2, cap_none=0.2), NOT),
        ("stable", {(FIRST, "distributed_printed"): outcome(0.5, 0.01, WIDE)}, OPEN),
        ("equal", forms(1.0, 1.0, 1.0), YES),
        ("equal", forms(1.1, 1.0, 1.0), OPEN),
        ("equal", forms(1.2, 1.0, 1.0), PARTLY),
        ("equal", forms(1.2, 1.2, 1.2), NOT),
        # Filters that have not ended are no evidence.
        ("equal", forms(1.0, 1.0, 1.0) | {(FIRST, "distributed"): outcome(9.0)}, YES),
        ("density", {}, YES),
        ("density", over(SAME_SHARE, "dv", wide), OPEN),
        ("density", over([Cell(8.0, 0.3)], "dv", level(9.0)), PARTLY),
        ("density", over([c for c in GRID if c.connectivity == 8.0], "dv", level(9.0)), NOT),
        ("saturation", {}, YES),
        ("saturation", over(HALF[:1], "dv", level(0.1)), PARTLY),
        ("saturation", over(HALF, "dv", level(0.1)), NOT),
        ("saturation", over(HALF, "dv", wide), OPEN),
        # Where more beacons do not help to begin with, nothing levels off.
        ("saturation", over(SAME_SHARE, "dv", level(0.4)), NOT),
        ("refined", {}, YES),
        ("refined", over([FIRST, MANY, DENSE], "distributed_printed", worse), PARTLY),
        ("refined", over([FIRST], "distributed_printed", worse), PARTLY),
        ("refined", over([FIRST], "distributed", worse), NOT),
        ("refined", over(GRID[:1], "distributed", wide), OPEN),
        # Sage's noise is told, and decides nothing; with ranging error there is a claim of its own.
        ("refined", over([FIRST, MANY, DENSE], "distributed_sage", worse), YES),
        ("refined", over(SWEEP, "distributed", worse), YES),
        ("gain_1", {}, YES),
        ("gain_1", over([FIRST], "distributed", lambda c: outcome(start(c) - 0.21)), YES),
        ("gain_1", over([FIRST], "distributed", lambda c: outcome(start(c) - 0.25)), PARTLY),
        ("gain_1", over([FIRST], "distributed", lambda c: outcome(start(c) - 0.08)), PARTLY),
        ("gain_1", over([FIRST], "distributed", worse), NOT),
        ("gain_1", over([FIRST], "distributed", wide), OPEN),
        ("gain_2", {}, YES),
        ("gain_2", over([MANY], "distributed", worse), NOT),
        ("gain_3", {}, YES),
        ("gain_3", over([DENSE], "distributed", lambda c: outcome(start(c) - 0.15)), PARTLY),
        ("where_most", {}, YES),
        ("where_most", over([MANY], "distributed", level(0.01)), PARTLY),
        ("where_most", over([MANY, DENSE], "distributed", level(0.01)), NOT),
        ("where_most", over([MANY, DENSE], "distributed", wide), OPEN),
        ("figure_5", {}, YES),
        ("figure_5", over(SWEEP[-1:], "dv", lambda c: outcome(start(SWEEP[0]), spread=WIDE)), OPEN),
        ("figure_5", over(SWEEP[2:3], "distributed", worse), PARTLY),
        ("figure_5", over(SWEEP[:1], "dv", level(2.0)), PARTLY),
        ("figure_5", over(SWEEP[:1], "dv", level(2.0)) | over(SWEEP[1:2], "distributed", worse), NOT),
    ],
)
def test_a_claim_is_judged_by_whole_intervals(claim, changes, verdict):
    assert judged(claim, changes) is verdict


@pytest.mark.parametrize(
    ("claim", "counted", "verdict"),
    [
        ("growth", costs(), YES),
        ("growth", costs({"dense": 2.14, "h_distributed": 0.86}), YES),
        ("growth", costs({"dense": 3.0}), PARTLY),
        ("growth", costs({"sparse": 1.1}), PARTLY),
        ("growth", costs({"distributed": 1.2}), PARTLY),
        ("growth", costs({"h_distributed": 1.2}), PARTLY),
        ("growth", costs({"h_dense": 1.8, "dense": 3.0}), NOT),
        ("messages", costs(), YES),
        ("messages", costs(messages_once=(0, 0, 2)), PARTLY),
        ("messages", costs(messages_once=(0, 0, 0), messages_step=(1, 0, 1)), NOT),
    ],
)
def test_counts_are_judged_as_they_are(claim, counted, verdict):
    assert judged(claim, {}, counted) is verdict


def test_few_draws_decide_nothing_but_counts():
    counts = {"growth": YES, "messages": YES}
    for claim in CLAIMS:
        assert judged(claim, {}, draws=20) is counts.get(claim, OPEN), claim
