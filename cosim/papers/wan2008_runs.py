"""Networks of Wan et al.'s experiment, and what each method makes of them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.distance import pdist

from ...align.consistency import nees
from ...network.localization.bound import cramer_rao
from ...network.localization.central_ekf import refine_central
from ...network.localization.distributed_ekf import RefinedPlane, refine_distributed
from ...network.localization.dv_distance import dv_distance, path_lateration
from ...network.localization.fading_ekf import FadingEkf
from ...network.localization.plane import in_plane
from ...network.localization.plane_chain import certain, locate_in_plane
from ...network.localization.plane_network import PlaneSolution, check_plane_network
from ...network.localization.problem import Booleans, RangeProblem
from ..run import generator
from .results import Array
from .wan2008_settings import Refinement

ASTRAY_RADII = 10.0
"""An error beyond which a node counts as lost: the fields are about ten radii wide."""


HELD_RADII = 0.25
"""Standard deviation of the bound up to which a node counts as held: further out the bound, which is of small
errors, is no measure."""


@dataclass(frozen=True)
class Cell:
    """A point of a figure: networks of one kind."""

    connectivity: float
    share: float
    error: float = 0.0
    """Standard deviation of a range, in radii."""
    radius_m: float | None = None
    """To which the networks are scaled; without it they fill the square."""


def cells_of(settings: Refinement) -> tuple[Cell, ...]:
    """All points of the figures, and the rigid network."""
    grid = [Cell(degree, share) for degree in settings.connectivities for share in settings.beacon_shares]
    sweep = [sweep_cell(settings, error) for error in settings.range_error_shares]
    return (*grid, *sweep, rigid_cell(settings))


def sweep_cell(settings: Refinement, error: float) -> Cell:
    """A point of Fig. 5."""
    return Cell(settings.connectivities[0], settings.low_share, error, settings.sweep_radius_m)


def rigid_cell(settings: Refinement) -> Cell:
    """The network for the bound."""
    return Cell(settings.rigid_connectivity, settings.rigid_share, settings.judged_error_share)


def elements_cell(settings: Refinement) -> Cell:
    """Where the elements of the filter are looked at one by one."""
    return Cell(settings.connectivities[1], settings.low_share)


def bounded(settings: Refinement, cell: Cell) -> bool:
    """Whether ratios to the bound are told there."""
    return cell.error == settings.judged_error_share


@dataclass(frozen=True)
class Network:
    """One draw of a cell."""

    settings: Refinement
    x: Array
    """(n, 2) m."""
    radius: float
    """m."""
    problem: RangeProblem
    exact: bool

    @property
    def range_sd(self) -> float:
        """m, what filters take it for at the start."""
        return float(self.problem.range_sd[0])

    @property
    def unknown(self) -> Booleans:
        """(n,)."""
        return ~self.problem.anchor

    @cached_property
    def start(self) -> Array:
        """(n, 2) m, DV-distance as the filters take it up."""
        return path_lateration(self.problem, self.settings.nearest_beacons)

    @cached_property
    def cold(self) -> PlaneSolution:
        """Ours."""
        return locate_in_plane(self.problem, covariance=not self.exact)

    @cached_property
    def bound(self) -> tuple[Array, Booleans]:
        """(n,) m^2, trace of the bound, and the nodes that ranges hold to within `HELD_RADII`."""
        bound = cramer_rao(self.problem, np.column_stack([self.x, np.zeros(len(self.x))]))
        variance = np.trace(bound.cov[:, :2, :2], axis1=1, axis2=2)
        held = (
            bound.localizable
            & self.unknown
            & (np.nan_to_num(variance, nan=np.inf) < (HELD_RADII * self.radius) ** 2)
        )
        return variance, held


def draw_network(settings: Refinement, cell: Cell, draw: int, seed: int) -> Network:
    """The same places for all cells of a draw, and more beacons where their share is larger.

    Raises `LocalizationError` for parts without beacons where the settings refuse them.
    """
    n, rng = settings.nodes, generator(seed, draw, "network")
    x = rng.uniform(0, settings.side_m, (n, 2))
    noise = rng.standard_normal(n * (n - 1) // 2)
    apart = pdist(x)
    count = round(cell.connectivity * n / 2)
    radius = float(np.partition(apart, count - 1)[count - 1])
    scale = 1.0 if cell.radius_m is None else cell.radius_m / radius
    linked = apart <= radius
    x, radius, apart = scale * x, scale * radius, scale * apart[linked]
    sd = max(cell.error, settings.assumed_error_radii) * radius
    # A range finder gives no negative range: of such an error another sign is taken.
    error = cell.error * radius * noise[linked]
    ranges = np.where(apart + error > 0, apart + error, apart - error)
    links = np.column_stack(np.triu_indices(n, 1))[linked]
    anchor = np.arange(n) < round(cell.share * n)
    problem = in_plane(links, ranges, np.full(len(links), sd), anchor, x)
    if settings.disconnected == "refuse":
        check_plane_network(problem)
    return Network(settings, x, radius, problem, cell.error == 0)


Estimate = tuple[Array, Array | None]
"""Positions (n, 2) m, NaN where there are none, and covariances (n, 2, 2) m^2 where they are claimed."""
Method = Callable[[Network], Estimate]


def _distributed(net: Network, **changes: object) -> Estimate:
    return _told(refine_distributed(net.problem, net.start, _ekf(net, changes)))


def _central(net: Network, dense: bool = False, **changes: object) -> Estimate:
    return _told(refine_central(net.problem, net.start, _ekf(net, changes), dense))


def _ekf(net: Network, changes: dict[str, object]) -> FadingEkf:
    return net.settings.ekf(net.radius, net.range_sd).model_copy(update=changes)


def _told(found: RefinedPlane) -> Estimate:
    return found.x, found.P


def _printed(net: Network) -> dict[str, object]:
    return net.settings.published(net.radius, net.range_sd).model_dump()


def _corrected(net: Network) -> Estimate:
    x = np.where(np.isfinite(net.start), dv_distance(net.problem)[:, :2], np.nan)
    return np.where(np.isfinite(x), x, net.start), None


def _certain(net: Network) -> Estimate:
    sure = certain(net.problem, net.cold.x)
    return np.where(sure[:, None], net.cold.x, np.nan), net.cold.cov


def _to_the_end(net: Network) -> int:
    """Steps within which filters end by their own stop rule."""
    return TO_THE_END * net.settings.max_steps


TO_THE_END = 10
"""Times the most steps of the study; some filters go round in a circle, and never stop by their rule."""

QUICK: dict[str, Method] = {
    "dv": lambda net: (net.start, None),
    "distributed": _distributed,
}
"""Methods of all cells."""
FULL: dict[str, Method] = QUICK | {
    "dv_all": lambda net: (path_lateration(net.problem, None, linear=True), None),
    "dv_corrected": _corrected,
    "distributed_printed": lambda net: _distributed(net, **_printed(net)),
    "distributed_sage": lambda net: _distributed(net, noise="positive"),
    "ours": lambda net: (net.cold.x, None if net.exact else net.cold.cov),
    "ours_certain": _certain,
}
"""And of those that are looked at closely."""
CENTRAL: dict[str, Method] = {"central": _central}
"""Besides, where the bound is."""
ENDED: dict[str, Method] = {
    "distributed_long": lambda net: _distributed(net, max_steps=_to_the_end(net)),
    "central_long": lambda net: _central(net, max_steps=_to_the_end(net)),
}
"""Besides, where the paper quotes figures: the two forms, each until its own stop rule ends it, or nearly."""
ELEMENTS: dict[str, Method] = CENTRAL | {
    "printed_step": lambda net: _distributed(net, **_printed(net) | {"stop": "step"}),
    "sage_husa": lambda net: _distributed(net, noise="sage_husa"),
    "cap_none": lambda net: _distributed(net, max_fading=1e300),
    "cap_1e4": lambda net: _distributed(net, max_fading=1e4),
    "cap_1": lambda net: _distributed(net, max_fading=1.0),
    "known": lambda net: _distributed(net, neighbor_covariance=False),
    "known_cap_none": lambda net: _distributed(net, neighbor_covariance=False, max_fading=1e300),
    "known_cap_1e4": lambda net: _distributed(net, neighbor_covariance=False, max_fading=1e4),
    "norms": lambda net: _distributed(net, stop="norms"),
    "central_printed": lambda net: _central(net, dense=True, **_printed(net)),
    "central_sage": lambda net: _central(net, noise="positive"),
}
"""One element of the filter at a time, as printed or as mended, at the cell of the paper's largest gain."""


def quoted_cells(settings: Refinement) -> tuple[Cell, ...]:
    """Points of Fig. 3 that the paper quotes gains of."""
    middle, last = settings.connectivities[1], settings.connectivities[-1]
    low, high = settings.low_share, settings.high_share
    return Cell(middle, low), Cell(middle, high), Cell(last, low)


def methods_of(settings: Refinement, cell: Cell) -> dict[str, Method]:
    """What is run at a cell."""
    if bounded(settings, cell):
        return FULL | CENTRAL
    if cell not in quoted_cells(settings):
        return QUICK
    return FULL | ENDED | (ELEMENTS if cell == elements_cell(settings) else {})


ERROR, COVERED, ASTRAY, SQUARES, BOUND, NEES = range(6)
"""Columns of a measure: mean error in radii over nodes with an estimate; their share; share of nodes lost;
over nodes with an estimate that ranges hold: mean squared error and bound, m^2, and NEES."""


def measures(net: Network, methods: dict[str, Method], bounded: bool) -> dict[str, Array]:
    """(6,) of each method; what needs the bound is NaN where it is not asked for."""
    return {key: _measure(net, *method(net), bounded) for key, method in methods.items()}


def _measure(net: Network, x: Array, cov: Array | None, bounded: bool) -> Array:
    told = net.unknown & np.isfinite(x[:, 0])
    error = np.linalg.norm(x - net.x, axis=1)
    row = np.full(6, np.nan)
    row[COVERED] = told.sum() / net.unknown.sum()
    if told.any():
        row[ERROR] = error[told].mean() / net.radius
        row[ASTRAY] = np.mean(error[told] > ASTRAY_RADII * net.radius)
    if bounded and (good := told & net.bound[1]).any():
        row[SQUARES], row[BOUND] = np.mean(error[good] ** 2), net.bound[0][good].mean()
        # Where P has lost its positiveness there is no consistency to speak of.
        if cov is not None and np.linalg.eigvalsh(cov[good]).min() > 0:
            row[NEES] = nees((x - net.x)[good], cov[good]).mean()
    return row
