"""The report of a replay: one HTML file that needs nothing else."""

from pathlib import Path
from typing import Any

import numpy as np

from ..align.estimate import FixOutcome
from .pages import number, write_page
from .palette import filter_color
from .replay import COMPONENTS, Replay
from .replay_figures import draw_replay
from .report import outcome_table
from .toml import to_toml

_FINAL = {
    "roll_deg": ("Roll, deg", 3),
    "pitch_deg": ("Pitch, deg", 3),
    "heading_deg": ("Heading, deg", 2),
    "accel_bias_x_ug": ("Accel x, ug", 0),
    "accel_bias_y_ug": ("y", 0),
    "accel_bias_z_ug": ("z", 0),
    "gyro_bias_x_deg_h": ("Gyro x, deg/h", 1),
    "gyro_bias_y_deg_h": ("y", 1),
    "gyro_bias_z_deg_h": ("z", 1),
}
_BASE = {
    "rows": ("rows", 0, ""),
    "interval_s": ("median interval, s", 4, ""),
    "jitter_s": ("greatest distance from it, s", 4, "times are kept as recorded"),
    "gaps": ("gaps", 0, ""),
    "inserted_rows": (
        "rows inserted in gaps",
        0,
        "empty; the filter holds the mean of the samples before, at a cost",
    ),
    "not_finite_rows": ("rows not finite", 0, "of the IMU: bridged likewise; of the fixes: left out"),
    "longest_gap_s": ("longest time between finite rows, s", 3, ""),
    "repeated_rows": ("repeats dropped", 0, "equal in time and in all values"),
    "moved_rows": ("rows put in order of time", 0, ""),
    "unused_rows": ("rows before the initial attitude", 0, "not used"),
}
_CHECKS = {
    "specific_force_mps2": ("specific force, m/s^2", 3, "median over the seconds; gravity is 9.8"),
    "turning_rate_deg_s": ("turning rate, deg/s", 2, "root mean square"),
    "tilt_deg": ("first specific force from the vertical, deg", 1, "by the initial attitude"),
    "turn_over_lean": ("turn of the gyros over that of the specific force", 2, "1 but for accelerations"),
    "turn_over_course": ("turn of the gyros over that of the course", 2, "1 but for slip and bank"),
    "displacement_over_velocity": ("way from fix to fix over that of the velocities", 3, "1"),
    "heading_minus_course_deg": ("initial heading minus course, deg", 1, "of the first fix that moves"),
}


def write_replay_report(path: Path, done: Replay, summary: dict[str, Any], manifest: dict[str, Any]) -> None:
    """Write the report, whole or not at all. Raises OSError."""
    outcomes = {name: {o: e.count(o) for o in FixOutcome} for name, e in done.estimates.items()}
    write_page(
        path,
        "replay.html.j2",
        draw_replay(done),
        summary=summary,
        manifest=manifest,
        files=[file.name for file in done.files],
        headline=headline(summary),
        final_names=[heading for heading, _ in _FINAL.values()],
        component_names=[_component(name) for name in COMPONENTS],
        rows=[_row(name, row) for name, row in summary["filters"].items()],
        bases=[
            (what, number(summary["imu"][key], digits), number(summary["fixes"][key], digits), note)
            for key, (what, digits, note) in _BASE.items()
        ],
        checks=[
            (what, number(summary["checks"][key], digits), note)
            for key, (what, digits, note) in _CHECKS.items()
        ],
        outcomes=outcome_table(outcomes),
        map_text=to_toml(done.settings.model_dump(mode="json")),
    )


def headline(summary: dict[str, Any]) -> str:
    """The result, and what was mended, in a few sentences."""
    told = []
    for name, row in summary["filters"].items():
        if row["outcome"] != "aligned":
            told.append(f"{name}: {row['outcome'].replace('_', ' ')}")
            continue
        heading = row["final"]["heading_deg"]
        refused = row["fixes"]["gated"]
        told.append(
            f"{name}: {row['updates']} updates, {refused or 'none'} refused, NIS {number(row['nis'], 2)} "
            f"of 6, heading {number(heading['value'], 2)} ± {number(heading['sd'], 2)} deg"
        )
    return f"{'; '.join(told)}. {repairs(summary)}"


def repairs(summary: dict[str, Any]) -> str:
    """What was mended in the two files, or that nothing was."""
    words = {
        "inserted_rows": "rows inserted in gaps",
        "not_finite_rows": "rows not finite",
        "repeated_rows": "repeats dropped",
        "moved_rows": "rows put in order",
    }
    done = [
        f"{summary[file][key]} {what} ({file})"
        for file in ("imu", "fixes")
        for key, what in words.items()
        if summary[file][key]
    ]
    return f"Mended: {', '.join(done)}." if done else "Nothing to mend in the time base."


def _row(name: str, row: dict[str, Any]) -> dict[str, Any]:
    nis, band = row["nis"], row["nis_band95"]
    innovations = row["innovations"] or {}
    return {
        "name": name,
        "color": filter_color(name),
        "outcome": row["outcome"],
        "updates": row["updates"],
        "nis": nis,
        "band": band,
        "outside": nis is not None and band is not None and not band[0] <= nis <= band[1],
        "final": [
            (row["final"][key]["value"], row["final"][key]["sd"], digits)
            for key, (_, digits) in _FINAL.items()
        ],
        "correlations": [
            innovations[component]["correlation_of_next"] if innovations else np.nan
            for component in COMPONENTS
        ],
    }


def _component(name: str) -> str:
    quantity, _, unit = name.rpartition("_")
    return f"{quantity.replace('_', ' ')}, {unit.replace('mps', 'm/s')}"
