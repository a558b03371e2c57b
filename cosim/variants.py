"""The variants of a scenario: the same flight, seeds and sensor errors, with other values for some fields."""

from collections.abc import Mapping
from typing import Any

from ..aircraft.flight import Flight
from ..align.estimate import Array
from ..network.fixes import Fixes
from .bound import BOUND_DRAWS, bound_of
from .clean_twin import clean_twin, has_faults
from .fault_score import FaultScorer
from .network_score import NetworkScorer
from .outputs import summarize_runs
from .run import Progress, alignment_window, simulate_all
from .scenario import Scenario, ScenarioError
from .score import FilterScore, Scorer, standard_deviations

AS_STATED = "as stated"
"""What the scenario itself is called beside its variants."""


def run_variants(
    scenario: Scenario, flight: Flight, scores: Mapping[str, FilterScore], progress: Progress | None = None
) -> dict[str, Any]:
    """Two blocks of `summary.json`: ``variants``, for each name ``filters``, ``paired`` and ``network``; and
    ``faults``, of those with faults, see `fault_score`.

    ``scores`` : of the scenario's own runs. Raises `ScenarioError` for a variant that flies another flight.
    """
    content: dict[str, Any] = {}
    faults: dict[str, Any] = {}
    clean = {AS_STATED: _final_errors(scores)}
    broken: dict[str, tuple[FaultScorer, dict[str, FilterScore]]] = {}
    names = {AS_STATED: scenario, **{name: scenario.variant(name) for name in scenario.variants}}
    total = scenario.runs * len(scenario.variants)
    for number, name in enumerate(scenario.variants):
        variant = names[name]
        if variant.flight != scenario.flight:
            raise ScenarioError(f"variants: {name!r} changes the flight, which all variants share")
        window = alignment_window(variant, flight)
        scorer, network = Scorer(window, variant.alignment.filters), NetworkScorer()
        judged = FaultScorer(variant, window) if has_faults(variant) else None
        fixes: list[Fixes] = []
        for done in simulate_all(variant, flight, variant.runs, variant.seed):
            scorer.add(done)
            if judged:
                judged.add(done)
            if len(fixes) < BOUND_DRAWS:
                fixes.append(done.fixes)
            if done.network is not None:
                network.add(done.network)
            if progress:
                progress(number * scenario.runs + done.run_id + 1, total)
        bound = bound_of(variant, window, fixes)
        floor = standard_deviations(window, bound, variant.imu.vibration_mps)[-1]
        found = scorer.scores()
        content[name] = summarize_runs(variant, found, network.score() if network.runs else None, floor)
        if judged:
            broken[name] = judged, found
        else:
            clean[name] = _final_errors(found)
    for name, (judged, found) in broken.items():
        twin = clean_twin(names[name], names)
        faults[name] = {"against": twin, **judged.rows(found, clean[twin] if twin else None)}
    return {"variants": content} | ({"faults": faults} if faults else {})


def _final_errors(scores: Mapping[str, FilterScore]) -> dict[str, Array]:
    """(runs, 5) by filter."""
    return {name: score.errors[:, -1] for name, score in scores.items()}
