"""The rules by which the claims of Uryvsky et al. are judged, on outcomes that are made up."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.cosim.papers.results import Verdict
from fleetalign.cosim.papers.uryvsky2018 import METHODS, RepeatedRanging
from fleetalign.cosim.papers.uryvsky2018_claims import claims
from fleetalign.cosim.papers.uryvsky2018_runs import Outcome

SETTINGS = RepeatedRanging.model_validate({"kind": "repeated_ranging"})
DRAWS, N = 30, SETTINGS.cycles
CASES = ("nominal", "unequal", "understated", "overstated", "outliers")
FILTERS = ("regularized", "adaptive", "regularized_adaptive")
FORMS = ("_printed", "_gain", "")
# Common to all methods, so that ratios have no spread unless a test gives them one.
NOISE = np.random.default_rng(0).uniform(0.8, 1.2, (DRAWS, 1))
COUNT = np.arange(1, N + 1)
WIDE = np.random.default_rng(1).permutation(np.repeat([0.1, 9.1], [27, 3]))[:, None]


def outcome(levels, nees=2.0, invalid=0.0):
    """Of an RMSE (N,), or one for all cycles."""
    squares = NOISE * np.broadcast_to(np.asarray(levels, float), N) ** 2
    spread = nees * (1 + 0.01 * (NOISE[:, 0] - 1))
    return Outcome(squares, spread, np.full(DRAWS, invalid), gain=np.tile(1 / COUNT, (DRAWS, 1)))


def falling(factor=1.0):
    """One over the root of the count, and a factor from the second cycle on."""
    return outcome(np.where(COUNT > 1, factor, 1.0) / np.sqrt(COUNT))


def spread(one):
    """The same with so much noise of its own that no interval says anything."""
    return replace(one, squares=one.squares * WIDE)


def judged(where, changes):
    found = {case: {name: falling() for name in METHODS} for case in CASES}
    for case in CASES:
        found[case] |= {"fix": outcome(1.0), "fix_printed": outcome(1.0)}
    for (case, name), made in changes.items():
        found[case][name] = made
    (claim,) = (c for c in claims(SETTINGS, found) if c.where == where)
    return claim.verdict


def over(made, names, cases=CASES):
    return {(case, name): made for case in cases for name in names}


YES, PARTLY, NOT, OPEN = Verdict.REPRODUCED, Verdict.PARTLY, Verdict.NOT, Verdict.UNDECIDED
PROPOSED = "regularized_adaptive"
ALL = tuple(PROPOSED + form for form in FORMS)
MADE = [f + form for f in ("regularized", "adaptive") for form in ("_gain", "")]
RISING = outcome(np.sqrt(COUNT))


@pytest.mark.parametrize(
    ("where", "changes", "verdict"),
    [
        ("eq. (3)", {}, YES),
        ("eq. (3)", {("unequal", "fix_printed"): outcome(1.0, invalid=0.8)}, PARTLY),
        ("eq. (3)", {("unequal", "fix_printed"): outcome(1.0, nees=2.5)}, PARTLY),
        ("eq. (3)", over(outcome(1.0, nees=2.5), ["fix_printed"]), NOT),
        ("eqs. (5) to (7)", {}, YES),
        ("eqs. (5) to (7)", {("nominal", "kalman_printed"): RISING}, PARTLY),
        ("eqs. (5) to (7)", over(RISING, ["kalman_printed", "kalman"]), NOT),
        ("eqs. (5) to (7)", over(spread(outcome(1.0)), ["kalman_printed"]), OPEN),
        ("eq. (8)", {}, NOT),
        ("eq. (8)", {("nominal", "kalman"): falling(1.1)}, YES),
        ("eq. (8)", {("nominal", "kalman"): falling(1.03)}, NOT),
        ("eq. (8)", {("nominal", "kalman"): spread(falling(1.05))}, OPEN),
        ("eq. (8)", over(outcome(np.where(COUNT > 10, 1.02, 1.0)), ["kalman", "bound"]), PARTLY),
        ("Description of the algorithm", {("unequal", "mean"): falling(2.0)}, YES),
        ("Description of the algorithm", {}, PARTLY),
        ("Description of the algorithm", {("unequal", "kalman"): falling(2.0)}, NOT),
        ("Description of the algorithm", {("unequal", "mean"): spread(falling(1.05))}, OPEN),
        ("eq. (12)", {}, YES),
        # Better than with noise as it is: no failure.
        ("eq. (12)", over(falling(0.7), ["adaptive"], ["overstated"]), YES),
        ("eq. (12)", over(falling(1.5), ["adaptive"], ["understated"]), PARTLY),
        ("eq. (12)", over(falling(1.5), ["adaptive" + f for f in FORMS], ["understated"]), NOT),
        # A form that is not stable is no evidence, whichever way.
        ("eq. (12)", over(RISING, ["adaptive_printed"], ["nominal"]), YES),
        ("eq. (12)", over(RISING, ["adaptive" + f for f in FORMS]), OPEN),
        ("Fig. 2", over(falling(1.1), MADE), YES),
        ("Fig. 2", over(falling(1.1), MADE, CASES[:3]), PARTLY),
        ("Fig. 2", over(falling(1.1), ["regularized", "adaptive"]), PARTLY),
        ("Fig. 2", over(falling(1.1), MADE, CASES[:2]), NOT),
        ("Fig. 2", over(spread(falling()), MADE), OPEN),
        ("Conclusion", {}, YES),
        ("Conclusion", {("outliers", ALL[0]): RISING}, PARTLY),
        ("Conclusion", over(RISING, ALL, ["outliers"]), NOT),
        ("Conclusion", {("outliers", ALL[0]): outcome(np.where(COUNT > 4, 1.2, 1.0) / COUNT**0.1)}, PARTLY),
        ("Results of the simulation", over(falling(0.9), ALL[1:2]), YES),
        ("Results of the simulation", over(falling(0.9), ALL, ["outliers"]), PARTLY),
        ("Results of the simulation", over(falling(1.1), ALL), NOT),
        ("Results of the simulation", over(falling(1.1), ALL) | over(spread(falling()), ALL[:1]), OPEN),
        ("Abstract, Conclusion", {}, NOT),
        ("Abstract, Conclusion", {("nominal", PROPOSED): falling(0.86)}, YES),
        ("Abstract, Conclusion", {("nominal", PROPOSED): outcome(0.86)}, YES),
        ("Abstract, Conclusion", {("outliers", PROPOSED): falling(0.86)}, PARTLY),
        # More than what is claimed is not what is claimed, and other conditions do not count.
        ("Abstract, Conclusion", over(falling(0.8), ALL), NOT),
        ("Abstract, Conclusion", over(falling(0.86), ALL, CASES[1:4]), NOT),
        ("Abstract, Conclusion", {("outliers", PROPOSED): spread(falling(0.86))}, OPEN),
    ],
)  # fmt: skip
def test_a_claim_is_judged_by_whole_intervals(where, changes, verdict):
    assert judged(where, changes) is verdict


def test_few_draws_decide_nothing():
    few = falling()
    few = replace(few, squares=few.squares[:20], nees=few.nees[:20], invalid=few.invalid[:20])
    found = {case: dict.fromkeys(METHODS, few) for case in CASES}
    assert {claim.verdict for claim in claims(SETTINGS, found)} == {Verdict.UNDECIDED}
