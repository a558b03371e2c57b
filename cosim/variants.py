"""The variants of a scenario: the same flight, seeds and sensor errors, with other values for some fields."""

from typing import Any

from ..aircraft.flight import Flight
from ..network.fixes import Fixes
from .bound import BOUND_DRAWS, bound_of
from .network_score import NetworkScorer
from .outputs import summarize_runs
from .run import Progress, alignment_window, simulate_all
from .scenario import Scenario, ScenarioError
from .score import Scorer, standard_deviations


def run_variants(scenario: Scenario, flight: Flight, progress: Progress | None = None) -> dict[str, Any]:
    """The block ``variants`` of `summary.json`: for each name ``filters``, ``paired`` and ``network``.

    Raises `ScenarioError` for a variant that flies another flight.
    """
    content: dict[str, Any] = {}
    total = scenario.runs * len(scenario.variants)
    for number, name in enumerate(scenario.variants):
        variant = scenario.variant(name)
        if variant.flight != scenario.flight:
            raise ScenarioError(f"variants: {name!r} changes the flight, which all variants share")
        window = alignment_window(variant, flight)
        scorer, network = Scorer(window, variant.alignment.filters), NetworkScorer()
        fixes: list[Fixes] = []
        for done in simulate_all(variant, flight, variant.runs, variant.seed):
            scorer.add(done)
            if len(fixes) < BOUND_DRAWS:
                fixes.append(done.fixes)
            if done.network is not None:
                network.add(done.network)
            if progress:
                progress(number * scenario.runs + done.run_id + 1, total)
        bound = bound_of(variant, window, fixes)
        floor = standard_deviations(window, bound, variant.imu.vibration_mps)[-1]
        score = network.score() if network.runs else None
        content[name] = summarize_runs(variant, scorer.scores(), score, floor)
    return content
