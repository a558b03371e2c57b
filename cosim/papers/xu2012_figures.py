"""Figures 3 to 11 of Xu et al. 2012, of the first draw, and errors over all draws."""

import numpy as np

from .results import Array, Curve, Panel, PaperFigure
from .xu2012 import BRIDGES, MATCHED, MENDED, PUBLISHED, WITH_BIAS, Trial

SPACING_M, REACH_M = 5.0, 11.0
"""Between the WSN's reference nodes, and how far they are heard (section 5.1)."""
_AXES = ("x", "y")


def figures_of(done: Trial) -> tuple[PaperFigure, ...]:
    """All figures."""
    filters = ("ins", MATCHED, PUBLISHED, MENDED)
    bridges = ("ins", *BRIDGES, WITH_BIAS)
    return (
        PaperFigure(
            "figure_3",
            "Fig. 3. Track, training areas with their reference nodes, outages.",
            ((_map(done),),),
            5.0,
        ),
        _pair(
            done, "figures_4_5", "Figs. 4 and 5. Position errors in the first training area.", filters, 0, 0
        ),
        _pair(
            done, "figures_6_7", "Figs. 6 and 7. Velocity errors in the first training area.", filters, 0, 2
        ),
        _pair(done, "figures_8_9", "Figs. 8 and 9. Position errors in the first outage.", bridges, 1, 0),
        _pair(done, "figures_10_11", "Figs. 10 and 11. Velocity errors in the first outage.", bridges, 1, 2),
        _over_draws(done),
    )


def reference_nodes(done: Trial, area: slice) -> Array:
    """(j, 2) nodes of a grid that are heard from somewhere in a training area."""
    track = done.world.course[0][area]
    low, high = track.min(axis=0) - REACH_M, track.max(axis=0) + REACH_M
    x, y = (np.arange(a, b, SPACING_M) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    apart = np.linalg.norm(grid[:, None] - track, axis=2)
    return grid[apart.min(axis=1) <= REACH_M]


def _map(done: Trial) -> Panel:
    track = done.world.course[0]
    areas = done.world.settings.stretches
    nodes = np.concatenate([reference_nodes(done, area) for area in areas[::2]])
    curves = [Curve("reference nodes", *nodes.T, look="points", color="#CFE8DA")]
    curves += [
        Curve("training area" if i % 2 == 0 else "outage", *track[part].T, color=color)
        for i, part in enumerate(areas)
        for color in (("#009E73", "#D55E00")[i % 2],)
    ]
    curves.append(Curve("start", *track[:1].T, look="points", color="black"))
    curves.append(Curve("end", *track[-1:].T, look="stars", color="#FFD24A"))
    return Panel("x, m", "y, m", tuple(curves), equal=True)


def _pair(
    done: Trial, name: str, caption: str, shown: tuple[str, ...], stretch: int, first: int
) -> PaperFigure:
    """Errors in x and y of the first draw; below, those that are too small to see beside the largest."""
    part = done.world.settings.stretches[stretch]
    time = done.world.time[part]
    unit = ("m", "m/s")[first // 2]
    worst = max(shown, key=lambda key: float(np.abs(done.methods[key].errors[0, part, first]).max()))

    def panel(c: int, keys: tuple[str, ...]) -> Panel:
        curves = [Curve(done.methods[key].name, time, done.methods[key].errors[0, part, c]) for key in keys]
        kind = ("position", "velocity")[first // 2]
        return Panel("time, s", f"{kind} error in {_AXES[c % 2]}, {unit}", tuple(curves))

    columns = (first, first + 1)
    rows = (shown, tuple(key for key in shown if key != worst))
    panels = tuple(tuple(panel(c, keys) for c in columns) for keys in rows)
    return PaperFigure(name, f"{caption} First draw; below without {done.methods[worst].name}.", panels, 5.6)


def _over_draws(done: Trial) -> PaperFigure:
    stretches = done.world.settings.stretches
    shaded = tuple(
        (float(done.world.time[part.start]), float(done.world.time[part.stop - 1]))
        for part in stretches[1::2]
    )
    keys = ("ins", MATCHED, PUBLISHED, MENDED, *BRIDGES, WITH_BIAS)

    def panel(first: int) -> Panel:
        part = slice(first, first + 2)
        curves = [
            Curve(
                done.methods[key].name,
                done.world.time,
                np.sqrt(np.sum(done.methods[key].errors[..., part] ** 2, axis=2).mean(axis=0)),
            )
            for key in keys
        ]
        floor = np.sqrt(done.bound[:, part].sum(axis=1))
        curves.append(Curve("bound", done.world.time, floor, look="dashed", color="black"))
        label = ("RMS position error, m", "RMS velocity error, m/s")[first // 2]
        return Panel("time, s", label, tuple(curves), log_y=True, shaded=shaded)

    caption = "RMS errors over all draws; outages shaded."
    return PaperFigure("over_draws", caption, ((panel(0), panel(2)),), 4.2)
