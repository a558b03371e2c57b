"""What `localize` leaves: `localize.json`, `localize.html`, and its tables on the terminal."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from .localize import LocalizeResults, LocalizeStudy
from .localize_figures import NAMES, RUNNING_S, draw_localize
from .localize_flight import BARO_SD_M, RANGE_SD_M, table_2
from .localize_paper import EQUATIONS_RADIUS_M, RADII_M, RANGING_ERRORS, TABLE_1
from .localize_verdicts import TABLE_2, figure_2_verdicts, figure_3_verdicts
from .network_score import plain
from .pages import number, percent, write_page
from .still import PROTOCOLS


def summarize(name: str, study: LocalizeStudy, results: LocalizeResults) -> dict[str, Any]:
    """Content of `localize.json`."""
    network, two, three = study.network, results.figure_2, results.figure_3
    verdicts = [*figure_2_verdicts(two), *figure_3_verdicts(three)]
    return plain(
        {
            "scenario": name,
            "seed": study.seed,
            "draws": study.draws,
            "nodes": network.fleet.nodes,
            "anchors": network.fleet.anchors,
            "link_radius_m": network.radio.link_radius_m,
            "range_sd_m": network.radio.range_sd_m,
            "epoch_s": study.epoch_s,
            "protocols": {
                kind: {"ranges": results.ranges[kind], "network": results.scores[kind].summary}
                for kind in PROTOCOLS
            },
            "equations": {
                "nodes": TABLE_1.nodes,
                "anchors": TABLE_1.anchors,
                "link_radius_m": EQUATIONS_RADIUS_M,
                "range_sd_m": RANGE_SD_M,
                "methods": results.equations,
            },
            "figure_2": {
                "radii_m": list(RADII_M),
                "ranging_errors": list(RANGING_ERRORS),
                "coverage": two.coverage,
                "position_error_m": two.error,
                "position_error_over_range": two.relative,
            },
            "figure_3": {
                "duration_s": float(three.time[-1]),
                "range_sd_m": RANGE_SD_M,
                "altitude_sd_m": BARO_SD_M,
                "mean_link_m": three.range,
                "bound_m": {"ranges alone": three.bound, "ranges and altitude": three.bound_with_baro},
                "table_2": table_2(three),
                "paper": TABLE_2,
            },
            "verdicts": [asdict(v) | {"line": v.line} for v in verdicts],
        }
    )


def write_localize(
    path: str | Path, title: str, results: LocalizeResults, summary: dict[str, Any], command: str
) -> None:
    """Write `localize.html`, whole or not at all. Raises OSError."""
    write_page(
        path,
        "localize.html.j2",
        draw_localize(results),
        title=title,
        summary=summary,
        command=command,
        names=NAMES,
        rows=indicator_rows(summary),
        running_s=RUNNING_S,
    )


def indicator_rows(summary: dict[str, Any]) -> list[tuple[str, list[str], str]]:
    """The paper's four indicators and more: name, one cell for each protocol, what it is."""
    both = [summary["protocols"][kind] for kind in PROTOCOLS]

    def row(name: str, what: str, cell: Any) -> tuple[str, list[str], str]:
        return name, [cell(p["ranges"], p["network"]) for p in both], what

    return [
        row("coverage", "nodes located, by ranges alone", lambda r, _: percent(r["coverage"], 1)),
        row("localisable", "nodes that these ranges hold", lambda r, _: percent(r["localizable"], 1)),
        row("position error, m", "mean of located nodes", lambda r, _: number(r["position_error_m"], 1)),
        row(
            "over the mean link",
            "the same, relative",
            lambda r, _: percent(r["position_error_over_range"], 3),
        ),
        row(
            "RMSE / CRLB",
            "of located nodes, with its standard deviation",
            lambda r, _: f"{number(r['rmse_over_crlb'], 3)} ± {number(r['rmse_over_crlb_sd'], 3)}",
        ),
        row(
            "flipped",
            "located nodes whose error noise does not explain",
            lambda r, _: percent(r["flipped"], 2),
        ),
        row(
            "coverage, range rates too",
            "nodes located, with range rates",
            lambda _, n: percent(n["coverage"], 1),
        ),
        *(
            row(f"fix, {name}", "RMSE of the own ship's fix", lambda _, n, k=key, d=digits: _fix(n, k, d))
            for name, key, digits in (
                ("horizontal, m", "horizontal_m", 1),
                ("vertical, m", "vertical_m", 1),
                ("velocity, m/s", "velocity_mps", 3),
            )
        ),
        row("fix, NEES of 6", "own ship, one a draw", lambda _, n: _nees(n)),
        row("its 95 % band", "of a mean over so many draws", lambda _, n: _band(n)),
        *(
            row(f"delay, {name}, ms", "all packets that arrive", lambda _, n, k=key: _delay(n, k))
            for name, key in (("mean", "mean"), ("50 %", "p50"), ("95 %", "p95"), ("99 %", "p99"))
        ),
        row(
            "time synchronism, arrived",
            "share within 50 ms of the packets that arrive",
            lambda _, n: percent(n["fleet_delay_ms"]["within_50_ms"], 1),
        ),
        row("time synchronism, sent", "the same of all packets sent", lambda _, n: percent(_in_time(n), 1)),
        row("delivered", "packets, of those sent", lambda _, n: percent(n["packets_delivered"], 1)),
        row(
            "link consumption",
            "transmissions a delivered packet",
            lambda _, n: number(n["transmissions_per_packet"], 2),
        ),
        row("slots used", "in which a node sent", lambda _, n: percent(n["slots_used"], 1)),
    ]


def _fix(network: dict[str, Any], component: str, digits: int) -> str:
    return number(network["own_fix"][f"rmse_{component}"], digits)


def _delay(network: dict[str, Any], figure: str) -> str:
    return number(network["fleet_delay_ms"][figure], 1)


def _nees(network: dict[str, Any]) -> str:
    band, mean = network["nees_band95"], number(network["nees"], 2)
    return mean if band is None or band[0] <= network["nees"] <= band[1] else f"outside: {mean}"


def _band(network: dict[str, Any]) -> str:
    low, high = network["nees_band95"] or (None, None)
    return f"{number(low, 2)} to {number(high, 2)}"


def _in_time(network: dict[str, Any]) -> float | None:
    arrived = network["fleet_delay_ms"]["within_50_ms"]
    return arrived and arrived * network["packets_delivered"]


def localize_tables(title: str, summary: dict[str, Any]) -> list[Table]:
    """Indicators of both protocols, and the paper's equations."""
    about = (
        f"{summary['nodes']} nodes, {summary['anchors']} anchors, links to"
        f" {summary['link_radius_m'] / 1000:g} km, ranges to {summary['range_sd_m']:g} m;"
        f" {summary['draws']} draws"
    )
    look = {"box": SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
    indicators = Table(title=Text(f"{title}: {about}"), **look)
    indicators.add_column("")
    for kind in PROTOCOLS:
        indicators.add_column(NAMES[kind], justify="right", no_wrap=True)
    for name, cells, _ in indicator_rows(summary):
        indicators.add_row(name, *cells)

    e = summary["equations"]
    methods = Table(
        title=Text(
            f"The paper's equations: {e['nodes']} nodes, {e['anchors']} anchors,"
            f" {e['link_radius_m'] / 1000:g} km, {e['range_sd_m']:g} m"
        ),
        **look,
    )
    methods.add_column("")
    for heading in ("RMSE / CRLB", "by node", "covered"):
        methods.add_column(heading, justify="right", no_wrap=True)
    for method in e["methods"]:
        ratio = f"{number(method['rmse_over_crlb'], 3)} ± {number(method['rmse_over_crlb_sd'], 3)}"
        node = number(method["node_over_crlb"], 3)
        methods.add_row(method["method"], ratio, node, percent(method["coverage"], 1))
    return [indicators, methods]
