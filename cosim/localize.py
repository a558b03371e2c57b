"""The fleet's network by itself: how well it locates, how late it is, and the paper's figures beside ours."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..aircraft.flight import Flight
from ..network.fleet import CentrePath
from ..network.fleet_network import FleetNetwork, fly_network
from ..network.localization.bound import cramer_rao
from ..network.localization.chain import localize
from ..network.localization.problem import NodeOutcome
from ..network.record import NetworkRecord
from .localize_flight import Figure3, figure_3, figure_3_of, flights
from .localize_paper import Figure2, equations, equations_table, figure_2, figure_2_of
from .network_score import NetworkScore, NetworkScorer
from .parallel import in_order
from .run import generator
from .still import PROTOCOLS, Drawn, draw_still, judge, pooled

Progress = Callable[[float, float], None]

# Seconds that a piece of work takes, about: for the progress bar.
_DRAW_S, _EQUATIONS_S, _FIGURE_2_S, _FIGURE_3_S = 0.3, 0.15, 1.2, 3.0


@dataclass(frozen=True)
class LocalizeStudy:
    """What is studied, and how often it is drawn.

    Draw i is the network of run i of the scenario with this seed, at one instant of its flight.
    """

    network: FleetNetwork
    flight: Flight
    epoch_s: float
    """The instant, s on the flight's clock."""
    draws: int = 200
    seed: int = 1
    figure_2_draws: int = 16
    """Fleets for each point of Fig. 2."""
    figure_3_s: float = 500.0
    """Duration of Fig. 3, from the start of the flight."""
    figure_3_rate_hz: float = 1.0
    """Epochs a second of Fig. 3."""

    @cached_property
    def path(self) -> CentrePath:
        """Of the fleet's centre, over the whole flight."""
        return CentrePath(self.flight, float(self.flight.time[0]), float(self.flight.time[-1]))

    def under(self, kind: str) -> FleetNetwork:
        """The network with DMDG or LEACH. Raises ValueError if it cannot work so."""
        content = self.network.model_dump()
        content["protocol"]["kind"] = kind
        return FleetNetwork.model_validate(content)


@dataclass(frozen=True)
class LocalizeResults:
    """All that a study found."""

    ranges: dict[str, dict[str, Any]]
    """For each protocol what the ranges of one instant give, by the production chain (`still.pooled`)."""
    scores: dict[str, NetworkScore]
    """For each protocol what the network gives, by ranges and range rates, and when it arrives."""
    records: dict[str, NetworkRecord]
    """Of the first draw."""
    equations: list[dict[str, Any]]
    figure_2: Figure2
    figure_3: Figure3


def run_study(study: LocalizeStudy, progress: Progress | None = None) -> LocalizeResults:
    """Do all of it. The same study gives the same results, whatever the cores.

    Raises ValueError, in one line, for a network that cannot work under one of the protocols.
    """
    networks = {kind: study.under(kind) for kind in PROTOCOLS}
    fleets = min(study.figure_2_draws, study.draws)
    parts = (
        (_DRAW_S, study.draws),
        (_EQUATIONS_S, study.draws),
        (_FIGURE_2_S, fleets),
        (_FIGURE_3_S, len(flights(study.network))),
    )
    total, done = sum(seconds * count for seconds, count in parts), 0.0

    def counted(results: Iterable[Any], seconds: float) -> Iterator[Any]:
        nonlocal done
        for result in results:
            done += seconds
            if progress:
                progress(done, total)
            yield result

    located: dict[str, list[Drawn]] = {kind: [] for kind in PROTOCOLS}
    scorers = {kind: NetworkScorer() for kind in PROTOCOLS}
    first: dict[str, NetworkRecord] = {}
    work = partial(_draw, study, networks)
    for draw in counted(in_order(work, range(study.draws)), _DRAW_S):
        for kind, (drawn, record) in draw.items():
            located[kind].append(drawn)
            scorers[kind].add(record)
            first.setdefault(kind, record)
    by_method = list(counted(equations(study.seed, study.draws), _EQUATIONS_S))
    by_error = list(counted(figure_2(study.seed, fleets), _FIGURE_2_S))
    duration_s, rate_hz = study.figure_3_s, study.figure_3_rate_hz
    flown = counted(figure_3(study.network, study.path, study.seed, duration_s, rate_hz), _FIGURE_3_S)
    return LocalizeResults(
        ranges={kind: pooled(drawn) for kind, drawn in located.items()},
        scores={kind: scorer.score() for kind, scorer in scorers.items()},
        records=first,
        equations=equations_table(by_method),
        figure_2=figure_2_of(by_error),
        figure_3=figure_3_of(dict(flown), study.network),
    )


def _draw(
    study: LocalizeStudy, networks: dict[str, FleetNetwork], i: int
) -> dict[str, tuple[Drawn, NetworkRecord]]:
    """One draw of the network under each protocol."""
    draws = partial(generator, study.seed, i)
    still, found = draw_still(study.network, draws), {}
    for kind, network in networks.items():
        problem = still.problem(kind)
        positions = localize(problem, network.localization)
        x = np.where((positions.outcome <= NodeOutcome.LOCATED)[:, None], positions.x, np.nan)
        drawn = judge(x, still, problem, cramer_rao(problem, still.x))
        _, record = fly_network(study.path, study.epoch_s, study.epoch_s, network, draws)
        found[kind] = drawn, record
    return found
