"""Figures 4 to 8 of Xu, Wang and Chen, drawn again: one deployment, Monte Carlo runs as printed."""

from typing import Literal

import numpy as np

from .results import Curve, Panel, PaperFigure
from .xu2019_runs import Shown
from .xu2019_settings import MovingAnchor

LINES = {
    "linear": "MLE, linear",
    "ckf_wide": "CKF",
    "srckf_wide": "SR-CKF",
    "srckf_printed": "SR-CKF with threshold",
    "srckf": "SR-CKF as mended",
    "exact": "mean of rings",
}
MAPS = {
    "linear": "Fig. 5: linear",
    "ckf_wide": "Fig. 6: CKF",
    "srckf_printed": "Fig. 7: SR-CKF with threshold",
    "srckf": "SR-CKF as mended",
}


def figures(settings: MovingAnchor, runs: dict[float, Shown]) -> tuple[PaperFigure, ...]:
    """One for each printed figure, 5 to 7 side by side."""
    count = settings.monte_carlo_runs
    first = next(iter(runs))
    return (
        PaperFigure(
            "figure_4",
            f"Fig. 4 again: mean positioning error (9) of each node over {count} runs. The paper's SR-CKF is"
            " the best of three; ours is the CKF, unless the threshold spoils it.",
            (tuple(_by_node(radius, shown) for radius, shown in runs.items()),),
        ),
        PaperFigure(
            "figures_5_to_7",
            f"Figs. 5 to 7 again, and the filter as mended: true places (circles) and estimates of {count}"
            f" runs (crosses), radius {first:g} m; dotted the UAV's path.",
            (tuple(_map(settings, runs[first], key, title) for key, title in MAPS.items()),),
            height_in=3.2,
        ),
        PaperFigure(
            "figure_8",
            f"Fig. 8 again: mean squared error over {settings.nodes} nodes in each of {count} runs.",
            (tuple(_by_run(radius, shown) for radius, shown in runs.items()),),
        ),
    )


def _by_node(radius: float, shown: Shown) -> Panel:
    number = np.arange(1.0, len(shown.x) + 1)
    curves = tuple(
        Curve(label, number, np.linalg.norm(shown.errors[key], axis=-1).mean(axis=0), look=_look(key))
        for key, label in LINES.items()
    )
    return Panel("node", "mean error, m", curves, f"radius {radius:g} m", log_y=True)


def _look(key: str) -> Literal["line", "crosses"]:
    # What the square root's line lies on.
    return "crosses" if key == "ckf_wide" else "line"


def _by_run(radius: float, shown: Shown) -> Panel:
    curves = []
    for key, label in LINES.items():
        mse = np.sum(shown.errors[key] ** 2, axis=-1).mean(axis=1)
        curves.append(Curve(label, np.arange(1.0, len(mse) + 1), mse, look=_look(key)))
    return Panel("run", "mean squared error, m²", tuple(curves), f"radius {radius:g} m", log_y=True)


def _map(settings: MovingAnchor, shown: Shown, key: str, title: str) -> Panel:
    beacons, estimates = settings.beacons(), (shown.x + shown.errors[key]).reshape(-1, 2)
    curves = (
        Curve("path", *beacons.T, look="dotted", color="#A8A8A8"),
        Curve("estimates", *estimates.T, look="crosses"),
        Curve("true places", *shown.x.T, look="points"),
    )
    return Panel("x, m", "y, m", curves, title, equal=True)
