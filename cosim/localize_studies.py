"""The two studies of the command `localize`: a fleet in all detail, and the scale of localisation."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from ..aircraft.flight import Flight
from ..network.fleet_network import FleetNetwork
from ..network.localization.large import LINK_RADIUS_M, RANGE_SD_M, large_study
from ..network.localization.problem import NodeOutcome
from .ground import locate_ground
from .ground_report import ground_table, summarize_ground, write_ground
from .localize import LocalizeStudy, Progress, run_study
from .localize_command import LARGEST
from .localize_report import localize_tables, summarize, write_localize
from .network_score import plain
from .run import alignment_window
from .scenario import Scenario, ScenarioError, replaced
from .scenery import told
from .still import PROTOCOLS

MOST_NODES = 200
"""Of a fleet that is studied in all detail; that of more nodes is the study of scale."""


@dataclass(frozen=True)
class Told:
    """What there is to tell of a study."""

    summary: dict[str, Any]
    """Content of `localize.json`."""
    parts: list[RenderableType]
    """For the terminal."""


def with_network(scenario: Scenario, origin: str, nodes: int | None) -> Scenario:
    """The scenario without variants, with so many nodes in its network.

    Raises `ScenarioError` for a network that does not work under each of the protocols.
    """
    kind = scenario.fixes.kind
    if not isinstance(scenario.fixes, FleetNetwork):
        raise ScenarioError(f"{origin}: fixes.kind = {kind!r}: there is no network to localize")
    if nodes is None:
        return _of_nodes(scenario, scenario.fixes.fleet.nodes, origin)
    try:
        return _of_nodes(scenario, nodes, "")
    except ScenarioError as error:
        why = str(error).splitlines()[0].removeprefix(": ")
        least = next((n for n in range(2, MOST_NODES + 1) if _works(scenario, n)), MOST_NODES + 1)
        told = f"--nodes {nodes}: allowed is [{least}, {LARGEST}] with {origin}: {why}"
        raise ScenarioError(told) from error


def _of_nodes(scenario: Scenario, nodes: int, origin: str) -> Scenario:
    scenario = replaced(scenario, {"fixes.fleet.nodes": nodes, "variants": {}}, origin)
    for protocol in PROTOCOLS:
        replaced(
            scenario, {"fixes.protocol.kind": protocol}, f"{origin}, under {protocol}".removeprefix(", ")
        )
    return scenario


def _works(scenario: Scenario, nodes: int) -> bool:
    try:
        _of_nodes(scenario, nodes, "")
    except ScenarioError:
        return False
    return True


def study_fleet(
    name: str,
    scenario: Scenario,
    flight: Flight,
    draws: int,
    page: Path,
    command: str,
    progress: Progress | None = None,
) -> Told:
    """Study the scenario's network, and write the page. Raises `ScenarioError`, OSError."""
    assert isinstance(scenario.fixes, FleetNetwork)
    try:
        epoch_s = float(alignment_window(scenario, flight).time[0])
    except ScenarioError as error:
        raise ScenarioError(f"{name}: {error}") from error
    study = LocalizeStudy(scenario.fixes, flight, epoch_s, draws, scenario.seed)
    results = run_study(study, progress)
    summary = summarize(name, study, results)
    write_localize(page, scenario.title, results, summary, command)
    lines = [Text(f"- {verdict['line']}") for verdict in summary["verdicts"]]
    return Told(summary, [*localize_tables(scenario.title, summary), *lines])


def study_ground(
    name: str,
    scenario: Scenario,
    flight: Flight,
    draws: int,
    page: Path,
    command: str,
    progress: Progress | None = None,
) -> Told:
    """Locate the scenario's nodes on the ground, and write the page. Raises `ScenarioError`, OSError."""
    assert scenario.ground
    try:
        found = locate_ground(flight, scenario.ground, draws, scenario.seed, progress)
    except ValueError as error:
        raise ScenarioError(f"{name}: {error}") from error
    summary = summarize_ground(scenario.ground, found)
    write_ground(page, scenario.title, found, summary, command)
    return Told(summary, [ground_table(summary)])


def study_scale(nodes: int, seed: int, progress: Progress | None = None) -> Told:
    """Locate ``nodes`` nodes from nothing and from near the truth."""
    found = plain(large_study(nodes, seed, progress))
    table = Table(
        title=Text(f"{nodes} nodes, links to {LINK_RADIUS_M / 1000:g} km, ranges to {RANGE_SD_M:g} m"),
        box=SIMPLE_HEAD,
        pad_edge=False,
        show_header=False,
    )
    table.add_column("", no_wrap=True)
    table.add_column("", justify="right", no_wrap=True)
    rows = {
        "links": f"{found['links']} ({found['mean_degree']:.1f} a node)",
        "anchors": f"{found['anchors']:.0f}",
        "cold start": f"{found['cold_s']:.1f} s",
        "near start": f"{found['near_s']:.1f} s",
        "median error": f"{found['median_error_sd']:.2f} sd of a range",
        "95 % of errors below": f"{found['p95_error_sd']:.2f} sd of a range",
        "located": f"{100 * found['located_share']:.2f} %",
        "located, and wrong": f"{100 * found['bad_share']:.4f} %",
        "cost over that of the near start": f"{found['cost_over_near']:.4f}",
        "most memory": f"{found['peak_memory_mb'] or float('nan'):.0f} MB",
    }
    for name, cell in rows.items():
        table.add_row(name, cell)
    for outcome in NodeOutcome:
        count = found[outcome.name.lower()]
        if outcome not in (NodeOutcome.ANCHOR, NodeOutcome.LOCATED) and count:
            table.add_row(f"not located: {told(outcome.name)}", f"{count:.0f}")
    return Told({"seed": seed, **found}, [table])
