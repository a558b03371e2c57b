"""The Rerun recording of one run: flight, tracks, errors against the truth, and what became of each fix.

Everything stands on one timeline, ``sim_time``, s from brake release. Entities:

``scene/...``
    In metres north, east, down of the flight's first row: the true path, the aircraft with its body axes
    (forward, right, down), each filter's track with its 3-sigma ellipsoid, the fixes.
``profile/...``
    The path with its heights exaggerated, its phases and its alignment marked.
``map/...``
    The same by latitude and longitude.
``flight/...``
    Altitude, speed, attitude, load factor, and the phase.
``errors/<channel>/<filter>``
    Estimate minus truth; ``.../three_sigma`` beside it, and the bound's under ``errors/<channel>/bound``.
``imu/<channel>/<filter>``, ``delay/<filter>``
    Estimated biases and mean delay with 3 sigma; what was drawn under ``drawn``.
``nis/<filter>``, ``outcome/<filter>``, ``log/<filter>``
    For each fix, at its arrival. ``outcome/<filter>/status`` : what the navigation rests on; its jumps are in
    the log.
``network/...``, ``network_fixes/...``, ``network_log``
    Where the run had a network: its nodes, links and errors about the fleet's centre; the own ship's fixes,
    their delays, and why some were not made or did not arrive.
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from ..aircraft.flight import Flight
from ..align.consistency import mean_band
from ..align.estimate import Estimate, FixOutcome, NavStatus
from ..align.measurement import DELAY
from ..network.fixes import Fixes
from ..sins import attitude, earth
from ..sins.error_model import ACCEL, GYRO, POSITION, VELOCITY
from ..sins.units import DEG, DEG_PER_HOUR, MICRO_G, MILLISECOND
from . import layout
from ._rerun import Columns
from .network_scenery import draw_network
from .palette import BOUND, OUTCOME_COLORS, STATUS_COLORS, TRUTH, filter_color, rgb
from .run import Run
from .scenery import draw_fixes, draw_flight, draw_track, told
from .score import COLUMNS, errors_against, standard_deviations

_RATE_HZ = 10.0
"""Of the truth in the recording."""
_EXPECTED = (FixOutcome.INITIALIZED, FixOutcome.PENDING)
"""Outcomes that are no cause for a warning."""


def write_recording(
    path: str | Path,
    title: str,
    flight: Flight,
    window: Flight,
    run: Run,
    bound: Estimate | None = None,
    vibration_mps: float = 0.0,
    outages: Sequence[tuple[float, float]] = (),
) -> None:
    """Write one run as an ``.rrd`` file whose layout opens on the flight, the map and the alignment.

    Parameters
    ----------
    flight : the whole of it. window : the part in which the run aligned.
    bound : estimate whose ``sd`` and ``misalignment_cov`` no filter beats.
    vibration_mps : as for `score.standard_deviations`.
    outages : begin and end, s, of times without fixes.

    The same arguments give recordings that are equal (``rerun rrd compare``). Raises OSError.
    """
    path = Path(path)
    path.touch()  # Rerun reports a file that cannot be written from a thread of its own.
    started = {name: e for name, e in run.estimates.items() if np.isfinite(e.lla).any()}
    errors = {name: _errors(window, estimate, vibration_mps) for name, estimate in started.items()}
    if bound is not None and np.isfinite(bound.lla).any():
        errors["bound"] = _errors(window, bound, vibration_mps)
    fixes = run.fixes.sorted_by_arrival()
    every = max(1, round(1 / (_RATE_HZ * flight.dt)))

    rec = rr.RecordingStream("fleetalign", recording_id=_identity(title, flight, run), send_properties=False)
    rec.save(path, default_blueprint=layout.blueprint(flight, window, run, errors))
    rec.send_recording_name(title)
    columns = Columns(rec)
    draw_flight(columns, flight, window, every)
    _plot_flight(columns, flight, every)
    _plot_errors(columns, errors)
    _plot_drawn_biases(columns, run, every)
    plot_biases(columns, started)
    if started:
        plot_delay(columns, started, fixes)
        plot_nis(columns, started, fixes)
    for name, estimate in started.items():
        draw_track(columns, flight.lla[0], name, estimate)
    for begin, end in outages:
        for time, text in ((begin, "begin"), (end, "end")):
            columns.send(
                "log/outages", [time], rr.TextLog.columns(text=[f"{text} of an outage of the fixes"])
            )
    for name, estimate in run.estimates.items():
        draw_fixes(columns, flight.lla[0], name, estimate, fixes)
        tell_outcomes(columns, name, estimate, fixes)
    if run.network is not None:
        draw_network(columns, run.network, float(flight.time[0]))
    rec.flush()
    rec.disconnect()


def _identity(title: str, flight: Flight, run: Run) -> str:
    """The same for the same run alone: a viewer merges recordings that share an identity."""
    digest = hashlib.sha256(title.encode())
    for array in (flight.q_nb, run.imu.dv_b, *(estimate.q_nb for estimate in run.estimates.values())):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]


def _errors(window: Flight, estimate: Estimate, vibration_mps: float) -> layout.Errors:
    """Time (m,), error (m,) and standard deviation (m,) by channel, from the first fix on."""
    started = np.isfinite(estimate.lla).all(axis=1)
    lla, v_n, _ = window.at(np.clip(estimate.time, window.time[0], window.time[-1]))
    names = [*COLUMNS, "v_down_mps", "north_m", "east_m", "down_m"]
    five, five_sd = errors_against(window, estimate), standard_deviations(window, estimate, vibration_mps)
    down_sd = np.hypot(estimate.sd[:, VELOCITY.stop - 1], vibration_mps)
    position = earth.displacement_n(estimate.lla, lla)
    error = np.column_stack([five, estimate.v_n[:, 2] - v_n[:, 2], position])[started]
    sd = np.column_stack([five_sd, down_sd, estimate.sd[:, POSITION]])[started]
    return {name: (estimate.time[started], error[:, i], sd[:, i]) for i, name in enumerate(names)}


def _plot_flight(columns: Columns, flight: Flight, every: int) -> None:
    rows = slice(None, None, every)
    euler = attitude.to_euler(flight.q_nb[rows]) / DEG
    channels = {
        "altitude_m": flight.lla[rows, 2],
        "speed_mps": np.linalg.norm(flight.v_n[rows], axis=1),
        "roll_deg": euler[:, 0],
        "pitch_deg": euler[:, 1],
        "heading_deg": euler[:, 2],
        "load_factor_g": flight.load_factor[rows],
    }
    for name, values in channels.items():
        columns.line(f"flight/{name}", flight.time[rows], values, TRUTH, name)
    starts = [phase.start_s for phase in flight.phases]
    names = [told(phase.name) for phase in flight.phases]
    columns.send("flight/phase", starts, rr.StateChange.columns(state=names))


def _plot_errors(columns: Columns, errors: dict[str, layout.Errors]) -> None:
    for name, channels in errors.items():
        color = BOUND if name == "bound" else filter_color(name)
        for channel, (time, error, sd) in channels.items():
            path = f"errors/{channel}/{name}"
            columns.three_sigma(path, time, 0.0, sd, color, name)
            if name != "bound":
                columns.line(path, time, error, color, name)


def _plot_drawn_biases(columns: Columns, run: Run, every: int) -> None:
    """Biases of the sensors that the run drew."""
    drawn, time = run.imu.errors, run.imu.time[::every]
    for channel, unit, constant, variation in (
        ("accel_bias_{}_ug", MICRO_G, drawn.accel_bias, drawn.accel_bias_variation),
        ("gyro_bias_{}_deg_h", DEG_PER_HOUR, drawn.gyro_bias, drawn.gyro_bias_variation),
    ):
        truth = constant + (np.zeros((len(run.imu.time), 3)) if variation is None else variation)
        for axis, values in zip("xyz", truth[::every].T / unit, strict=True):
            columns.line(f"imu/{channel.format(axis)}/drawn", time, values, TRUTH, "drawn")


def plot_biases(columns: Columns, estimates: dict[str, Estimate]) -> None:
    """Estimated biases of the sensors."""
    for name, e in estimates.items():
        started = np.isfinite(e.accel_bias).all(axis=1)
        time, color = e.time[started], filter_color(name)
        for i, axis in enumerate("xyz"):
            for path, unit, bias, sd in (
                (f"imu/accel_bias_{axis}_ug/{name}", MICRO_G, e.accel_bias, e.sd[:, ACCEL]),
                (f"imu/gyro_bias_{axis}_deg_h/{name}", DEG_PER_HOUR, e.gyro_bias, e.sd[:, GYRO]),
            ):
                value = bias[started, i] / unit
                columns.line(path, time, value, color, name)
                columns.three_sigma(path, time, value, sd[started, i] / unit, color, name)


def plot_delay(columns: Columns, estimates: dict[str, Estimate], fixes: Fixes) -> None:
    """The delay of each fix, and the mean delay of those filters that estimate it."""
    delay = (fixes.t_arrival - fixes.t_valid) / MILLISECOND
    columns.points("delay/drawn", fixes.t_arrival, delay, TRUTH, "each fix", size=2.0)
    for name, e in estimates.items():
        started = np.isfinite(e.delay)
        sd = e.sd[started, DELAY] / MILLISECOND
        if sd.any():
            time, mean, color = e.time[started], e.delay[started] / MILLISECOND, filter_color(name)
            columns.line(f"delay/{name}", time, mean, color, f"{name}: mean")
            columns.three_sigma(f"delay/{name}", time, mean, sd, color, name)


def plot_nis(columns: Columns, estimates: dict[str, Estimate], fixes: Fixes) -> None:
    """Each fix's normalised innovation squared, with the band that most should keep to."""
    for name, estimate in estimates.items():
        computed = np.isfinite(estimate.nis)
        time, nis = fixes.t_arrival[computed], estimate.nis[computed]
        columns.points(f"nis/{name}", time, nis, filter_color(name), name, size=2.5)
    limits = np.tile([*mean_band(6, 1), 6.0], (2, 1))
    name = "mean and 95 % band of chi-square, 6 d.o.f."
    columns.line("nis/limits", fixes.t_arrival[[0, -1]], limits, TRUTH, name, width=1.0)


def tell_outcomes(columns: Columns, name: str, estimate: Estimate, fixes: Fixes) -> None:
    """Lanes of outcomes and of the status, and a line of text for each fix that was not fused and for each
    jump."""
    words = _lane(columns, f"outcome/{name}", OUTCOME_COLORS)
    _tell_status(columns, name, estimate)
    outcomes = [FixOutcome(outcome) for outcome in estimate.fix_outcome]
    states = [words[outcome] for outcome in outcomes]
    columns.send(f"outcome/{name}", fixes.t_arrival, rr.StateChange.columns(state=states))
    rows = [i for i, outcome in enumerate(outcomes) if outcome is not FixOutcome.FUSED]
    text = [
        f"{name}: fix {fixes.sequence[i]} of node {fixes.source[i]},"
        f" valid at {fixes.t_valid[i]:.3f} s: {states[i]}"
        for i in rows
    ]
    levels = ["INFO" if outcomes[i] in _EXPECTED else "WARN" for i in rows]
    columns.send(f"log/{name}", fixes.t_arrival[rows], rr.TextLog.columns(text=text, level=levels))


def _lane(columns: Columns, path: str, colors: Mapping[Any, str]) -> dict[Any, str]:
    """Begin a lane of states; returns what each is called in it."""
    words = {state: told(state.name) for state in colors}
    labels = list(words.values())
    looks = [rgb(color) for color in colors.values()]
    columns.static(path, rr.StateConfiguration(values=labels, labels=labels, colors=looks))
    return words


def _tell_status(columns: Columns, name: str, estimate: Estimate) -> None:
    path = f"outcome/{name}/status"
    words = _lane(columns, path, STATUS_COLORS)
    changes = np.flatnonzero(np.diff(estimate.status, prepend=-1))
    states = [words[NavStatus(status)] for status in estimate.status[changes]]
    columns.send(path, estimate.time[changes], rr.StateChange.columns(state=states))
    jumps = np.flatnonzero(estimate.jumped)
    text = [f"{name}: corrected by {estimate.jump[i]:.1f} standard deviations" for i in jumps]
    columns.send(
        f"log/{name}", estimate.time[jumps], rr.TextLog.columns(text=text, level=["WARN"] * len(text))
    )
