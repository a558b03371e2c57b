"""Wan, Wu, Feng: DV-distance in a plane network, refined by a fading adaptive EKF, distributed or central."""

from dataclasses import dataclass

import numpy as np

from ..parallel import in_order
from . import wan2008_costs
from . import wan2008_tables as tell
from .results import Array, Progress, Results
from .wan2008_claims import claims
from .wan2008_figures import figures
from .wan2008_runs import (
    TO_THE_END,
    Cell,
    bounded,
    cells_of,
    draw_network,
    measures,
    methods_of,
    rigid_cell,
)
from .wan2008_settings import Refinement

__all__ = ["Refinement", "study"]


@dataclass(frozen=True)
class _Work:
    """A draw of all cells."""

    settings: Refinement
    seed: int
    cells: tuple[Cell, ...]

    def __call__(self, draw: int) -> list[dict[str, Array]]:
        settings = self.settings
        return [
            measures(
                draw_network(settings, cell, draw, self.seed),
                methods_of(settings, cell),
                bounded(settings, cell),
            )
            for cell in self.cells
        ]


def study(settings: Refinement, draws: int, seed: int, progress: Progress | None = None) -> Results:
    """All cells on the same draws, costs over the number of nodes, the five nodes of Fig. 2, the claims."""
    cells = cells_of(settings)
    gathered: list[list[dict[str, Array]]] = []
    for done in in_order(_Work(settings, seed, cells), range(draws)):
        gathered.append(done)
        if progress:
            progress(len(gathered), draws + 2)
    found = {
        cell: {key: np.array([draw[i][key] for draw in gathered]) for key in gathered[0][i]}
        for i, cell in enumerate(cells)
    }
    counted = wan2008_costs.costs(settings, seed)
    if progress:
        progress(draws + 1, draws + 2)
    example = tell.five_nodes(settings, max(draws, 100), seed)
    tables = [tell.connectivity_table(settings, degree, found) for degree in settings.connectivities]
    tables += [
        tell.elements_table(settings, found),
        tell.sweep_table(settings, found, draws),
    ]
    tables += [
        tell.bound_table(settings, found[rigid_cell(settings)], draws),
        wan2008_costs.table(counted),
        example,
    ]
    return Results(
        tables=tuple(tables),
        claims=claims(settings, found, counted),
        figures=figures(settings, found),
        notes=(
            "Not in the paper, and ours: the side of the field, the number of beacons a node is located by"
            f" ({settings.nearest_beacons}), P, Q and R at the start, the limit of lambda, the scale"
            " of Fig. 5.",
            "Errors are means over nodes that have an estimate, in % of the radius; a node has one if paths"
            " join it to three beacons. Filters that diverge stand where they were last, so that their means"
            " say no more than that: the column of lost nodes counts errors of more than ten radii.",
            f"Filters end by their stop rule, or after {settings.max_steps} steps; those to the end may take"
            f" {TO_THE_END * settings.max_steps}.",
            "Costs are counted in one network of each size, and messages for the most steps there may be,"
            " which most of them need: some filters never end by their stop rule.",
            "The sparse central form is not the printed filter: it has no Q, and puts back as at the start"
            " what fading forgets.",
            "Without ranging error the bound is zero: such tables have errors only.",
            "Ratios to the bound and NEES are over nodes whose bound is below a quarter of a radius; NEES"
            " bands are those of one node a draw, and so too wide for means over a network.",
            "The filters take the same ranges again at each step as if they were new: what P states falls"
            " below what the ranges hold, and they are inconsistent, mended as well.",
        ),
    )
