"""What `maneuver` leaves: `maneuver.json`, `maneuver.toml`, `maneuver.html`, and a table on the terminal."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from ..sins.units import DEG
from .maneuver import Flown, ManeuverStudy
from .maneuver_figures import draw_maneuver
from .network_report import level
from .network_score import plain
from .outputs import summarize_runs
from .pages import number, write_page
from .resampling import bootstrap_rms_interval
from .scenario_file import scenario_toml
from .score import COLUMNS

NAMES = {"s": "the scenario's S", "best": "best manoeuvre"}
TARGET = {"level_arcsec": 8.0, "heading_arcmin": 0.2}


def summarize(name: str, study: ManeuverStudy) -> dict[str, Any]:
    """Content of `maneuver.json`."""
    found, profile, scenario = study.maneuver, study.maneuver.profile, study.best.scenario
    attempts = [
        {
            "start": attempt.start,
            "outcome": attempt.outcome.value,
            "solver_status": attempt.solver_status,
            "iterations": attempt.iterations,
            "cost": attempt.cost,
            "level_arcsec": attempt.profile.level_arcsec[-1],
            "heading_arcmin": attempt.profile.heading_arcmin[-1],
            "course_deg": (attempt.profile.heading[-1] - attempt.profile.heading[0]) / DEG,
        }
        for attempt in sorted(found.attempts, key=lambda attempt: attempt.cost)
    ]
    content = {
        "scenario": name,
        "seed": scenario.seed,
        "runs": scenario.runs,
        "limits": study.limits.model_dump(),
        "search": study.search.model_dump() | {"seconds": round(study.seconds, 2)},
        "fixes": {
            "rate_hz": study.task.rate_hz,
            "position_sd_m": study.task.position_sd_m,
            "velocity_sd_mps": study.task.velocity_sd_mps,
        },
        "outcome": found.outcome.value,
        "cost": found.cost,
        "attempts": attempts,
        "grid": {"held_the_limits": len(study.grid), "best": vars(study.grid[0]) if study.grid else None},
        "profile": {
            "time_s": profile.time,
            "bank_deg": profile.bank / DEG,
            "course_deg": (profile.heading - profile.heading[0]) / DEG,
            "level_arcsec": profile.level_arcsec,
            "heading_arcmin": profile.heading_arcmin,
        },
        "flown": {key: _flown(getattr(study, key)) for key in NAMES},
    }
    return plain(content)


def _flown(flown: Flown) -> dict[str, Any]:
    window, plan = flown.window, flown.scenario.flight
    speed, altitude = np.linalg.norm(window.v_n, axis=1), window.lla[:, 2] - plan.altitude_m
    bank_error = (window.bank - flown.asked_bank) / DEG
    bound: dict[str, Any] = dict(zip(COLUMNS, flown.bound_sd[-1].tolist(), strict=True))
    unstamped: dict[str, Any] = dict(zip(COLUMNS, flown.unstamped_sd.tolist(), strict=True))
    filters = summarize_runs(flown.scenario, flown.scores, None, flown.bound_sd[-1])["filters"]
    for name, row in filters.items():
        levels = np.sqrt(np.mean(flown.scores[name].errors[:, -1, :2] ** 2, axis=1, keepdims=True))
        interval = bootstrap_rms_interval(levels)[:, 0]
        row |= {"level_arcsec": level(row), "level_ci95": interval if np.isfinite(interval).all() else None}
    return {
        "bound": bound | {"level_arcsec": level(bound)},
        "bound_delay_unknown": unstamped | {"level_arcsec": level(unstamped)},
        "filters": filters,
        "largest_bank_deg": np.abs(window.bank).max() / DEG,
        "bank_error_rms_deg": np.sqrt(np.mean(bank_error**2)),
        "bank_error_largest_deg": np.abs(bank_error).max(),
        "altitude_low_m": altitude.min(),
        "altitude_high_m": altitude.max(),
        "speed_low_mps": speed.min(),
        "speed_high_mps": speed.max(),
        "load_factor_low_g": window.load_factor.min(),
        "load_factor_high_g": window.load_factor.max(),
        "excursion_deg": np.abs(flown.course).max() / DEG,
        "course_at_end_deg": flown.course[-1] / DEG,
    }


def write_maneuver(
    path: str | Path, title: str, study: ManeuverStudy, summary: dict[str, Any], command: str
) -> None:
    """Write `maneuver.html`, whole or not at all. Raises OSError."""
    write_page(
        path,
        "maneuver.html.j2",
        draw_maneuver(study),
        title=title,
        summary=summary,
        names=NAMES,
        target=TARGET,
        command=command,
        filters=list(study.best.scores),
        scenario_text=scenario_toml(study.best.scenario),
    )


def maneuver_table(title: str, summary: dict[str, Any]) -> Table:
    """Bound and filters at the end, for both manoeuvres."""
    table = Table(
        title=Text(f"{title}\nRMS over {summary['runs']} runs at the end"),
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=0,
        min_width=72,
    )
    table.add_column("", no_wrap=True)
    for heading in ("level\narcsec", "roll\narcsec", "pitch\narcsec", "heading\narcmin", "failed\nruns"):
        table.add_column(heading, justify="right", no_wrap=True)
    for key, name in NAMES.items():
        flown = summary["flown"][key]
        for what, bound in (("bound", "bound"), ("bound, delay unknown", "bound_delay_unknown")):
            table.add_row(Text(f"{name}: {what}"), *_cells(flown[bound]), "", style="dim")
        for filter_name, row in flown["filters"].items():
            table.add_row(Text(f"{name}: {filter_name}"), *_cells(row), str(row["failed_runs"]))
    return table


def _cells(row: dict[str, Any]) -> list[str]:
    columns = ("level_arcsec", "roll_arcsec", "pitch_arcsec")
    return [*[number(row[column], 2) for column in columns], number(row["heading_arcmin"], 3)]


def told_lines(summary: dict[str, Any]) -> list[str]:
    """The search in a few lines."""
    profile, best = summary["profile"], summary["grid"]["best"]
    lines = [
        f"search: {summary['outcome']} in {summary['search']['seconds']:.0f} s from"
        f" {len(summary['attempts'])} starts; the profile's bound at its end: level"
        f" {profile['level_arcsec'][-1]:.2f} arcsec, heading {profile['heading_arcmin'][-1]:.3f} arcmin;"
        f" it ends {profile['course_deg'][-1]:.0f} deg off course"
    ]
    if best:
        lines.append(
            f"best of {summary['grid']['held_the_limits']} S-manoeuvres within the limits:"
            f" {best['bank_deg']:.0f} deg, {best['period_s']:.1f} s, phase {best['phase_deg']:.0f} deg: level"
            f" {best['level_arcsec']:.2f} arcsec, heading {best['heading_arcmin']:.3f} arcmin"
        )
    return lines
