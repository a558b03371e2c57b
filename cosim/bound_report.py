"""What the command `bound` leaves: every state's bound over time, as numbers and as one HTML file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..aircraft.flight import Flight
from ..align.bound import Knowledge
from ..align.estimate import Array, Estimate
from ..align.measurement import DELAY, LEVER
from ..sins.error_model import ACCEL, GYRO, POSITION, VELOCITY
from ..sins.units import DEG_PER_HOUR, MICRO_G, MILLISECOND
from .drawing import STYLE, legend, log_scale, panels, svg
from .figures import BOUND_NAMES
from .network_score import plain
from .outputs import write_parquet
from .pages import write_page
from .scenario import Scenario
from .score import standard_deviations
from .toml import to_toml

STATES = {
    "north_m": "north, m",
    "east_m": "east, m",
    "down_m": "down, m",
    "v_north_mps": "v north, m/s",
    "v_east_mps": "v east, m/s",
    "v_down_mps": "v down, m/s",
    "roll_arcsec": "roll, arcsec",
    "pitch_arcsec": "pitch, arcsec",
    "heading_arcmin": "heading, arcmin",
    "accel_bias_x_ug": "accel x, ug",
    "accel_bias_y_ug": "accel y, ug",
    "accel_bias_z_ug": "accel z, ug",
    "gyro_bias_x_deg_h": "gyro x, deg/h",
    "gyro_bias_y_deg_h": "gyro y, deg/h",
    "gyro_bias_z_deg_h": "gyro z, deg/h",
    "delay_ms": "delay, ms",
    "lever_arm_x_m": "lever arm x, m",
    "lever_arm_y_m": "lever arm y, m",
    "lever_arm_z_m": "lever arm z, m",
}
"""States of the bound, with their units, and what tables and figures call them."""
_PANELS = {
    "position, m": slice(0, 3),
    "velocity, m/s": slice(3, 6),
    "level, arcsec": slice(6, 8),
    "heading, arcmin": slice(8, 9),
    "accelerometer bias, ug": slice(9, 12),
    "gyro bias, deg/h": slice(12, 15),
}
_STYLES = {Knowledge.STAMPED: "-", Knowledge.DELAY_UNKNOWN: ":", Knowledge.SMOOTHED: "-."}
_COLORS = ("#D55E00", "#3D8FD1", "#009E73")


def states_of(window: Flight, bound: Estimate) -> Array:
    """Standard deviations over time of the states in the order and the units of `STATES`, (m, 19).

    NaN for what is no state: a delay that stamps tell, a lever arm that is known.
    """
    attitude_sd = standard_deviations(window, bound, 0.0)[:, :3]
    sd = bound.sd
    delay = np.where(sd[:, [DELAY]] > 0, sd[:, [DELAY]] / MILLISECOND, np.nan)
    arm = sd[:, LEVER] if sd.shape[1] > LEVER.start else np.full((len(sd), 3), np.nan)
    biases = [sd[:, ACCEL] / MICRO_G, sd[:, GYRO] / DEG_PER_HOUR]
    return np.hstack([sd[:, POSITION], sd[:, VELOCITY], attitude_sd, *biases, delay, arm])


def summarize_bounds(
    name: str, scenario: Scenario, draws: int, window: Flight, bounds: Mapping[str, Estimate]
) -> dict[str, Any]:
    """Content of `bound.json`: each bound at the end of the alignment."""
    ends = {key: states_of(window, bound)[-1] for key, bound in bounds.items()}
    return {
        "scenario": name,
        "seed": scenario.seed,
        "draws": draws,
        "after_s": round(float(window.time[-1] - window.time[0]), 6),
        "bound": {key: plain(dict(zip(STATES, end.tolist(), strict=True))) for key, end in ends.items()},
    }


def write_bounds(path: Path, window: Flight, bounds: Mapping[str, Estimate]) -> None:
    """Write all bounds over time as Parquet: name of the bound, time from brake release, the states."""
    time = np.concatenate([bound.time for bound in bounds.values()])
    names = np.repeat(list(bounds), [len(bound.time) for bound in bounds.values()])
    states = np.concatenate([states_of(window, bound) for bound in bounds.values()])
    write_parquet(path, {"bound": names, "time_s": time} | dict(zip(STATES, states.T, strict=True)))


def write_bound_report(
    path: Path,
    scenario: Scenario,
    window: Flight,
    bounds: Mapping[str, Estimate],
    summary: dict[str, Any],
    command: str,
) -> None:
    """Write the report, whole or not at all. Raises OSError."""
    with mpl.rc_context(STYLE):
        figures = {"states": svg(_draw(window, bounds))}
    write_page(
        path,
        "bound.html.j2",
        figures,
        scenario=scenario,
        summary=summary,
        states=STATES,
        rows=[(BOUND_NAMES[Knowledge(key)], row) for key, row in summary["bound"].items()],
        command=command,
        scenario_text=to_toml(scenario.model_dump(mode="json")),
    )


def _draw(window: Flight, bounds: Mapping[str, Estimate]) -> Figure:
    figure, axes = panels(2, 3, 6.2, hspace=0.25)
    labels = list(STATES.values())
    for number, (title, columns) in enumerate(_PANELS.items()):
        ax: Axes = axes[number // 3][number % 3]
        for key, style in _STYLES.items():
            time, states = bounds[key].time - window.time[0], states_of(window, bounds[key])
            for i in range(columns.start, columns.stop):
                color = _COLORS[i - columns.start]
                name = labels[i].split(",")[0]
                ax.plot(
                    time, states[:, i], style, color=color, label=name if key is Knowledge.STAMPED else None
                )
        ax.set(ylabel=title, xlabel="time from the start of the alignment, s" if number >= 3 else None)
        if "bias" in title:
            ax.set_ylim(bottom=0.0)  # next to nothing may be learnt of them
        else:
            log_scale(ax)
        ax.legend(fontsize=8, loc="lower left" if "bias" in title else "upper right")
    for key, style in _STYLES.items():
        axes[0][0].plot([], [], style, color="black", label=BOUND_NAMES[key])
    legend(figure, axes[0][0])
    return figure
