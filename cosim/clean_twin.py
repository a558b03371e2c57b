"""Scenarios without what breaks in them: what those with faults are judged against."""

from collections.abc import Mapping
from typing import Any

from ..network.faults import NetworkFaults
from ..network.fleet_network import FleetNetwork
from .scenario import Faults, Scenario


def without_faults(scenario: Scenario) -> Scenario:
    """The scenario as it would be if nothing broke; without its variants."""
    changes: dict[str, Any] = {"faults": Faults(), "outages": (), "variants": {}}
    if isinstance(scenario.fixes, FleetNetwork):
        changes["fixes"] = scenario.fixes.model_copy(update={"faults": NetworkFaults()})
    return scenario.model_copy(update=changes)


def has_faults(scenario: Scenario) -> bool:
    """Whether anything breaks in it, outages included."""
    return without_faults(scenario) != scenario.model_copy(update={"variants": {}})


def clean_twin(scenario: Scenario, others: Mapping[str, Scenario]) -> str | None:
    """Name of the scenario that is like this one but for its faults, or None."""
    wanted = without_faults(scenario)
    for name, other in others.items():
        if not has_faults(other) and without_faults(other) == wanted:
            return name
    return None
