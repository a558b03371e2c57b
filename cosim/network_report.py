"""The tables of the report's network page."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..network.record import FixFate
from .scenery import told
from .score import COLUMNS, GROUPS

_DELAY_COLUMNS = ("mean", "sd", "p50", "p95", "p99")


def level(row: Mapping[str, Any]) -> float:
    """RMS of roll and pitch error, arcsec; NaN if there is none."""
    return _joint(row, ("roll_arcsec", "pitch_arcsec"))


def _joint(row: Mapping[str, Any], columns: tuple[str, ...]) -> float:
    values = [np.nan if row[column] is None else row[column] for column in columns]
    return float(np.sqrt(np.mean(np.square(values))))


def network_tables(network: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of the network page from the block ``network`` of `summary.json`."""
    fates = network["fates"]
    epochs = max(sum(fates.values()), 1)
    delays = {
        "the own ship's fixes": network["delay_ms"],
        "all packets of the fleet": network["fleet_delay_ms"],
    }
    nees, band = network["nees"], network["nees_band95"]
    outside = nees is not None and band is not None and not band[0] <= nees <= band[1]
    return {
        "figures": {**network, "nees_outside": outside},
        "delays": [
            (name, [delay[column] for column in _DELAY_COLUMNS], delay["within_50_ms"])
            for name, delay in delays.items()
        ],
        "fates": [
            (told(fate.name), fates[fate.name.lower()], 100 * fates[fate.name.lower()] / epochs)
            for fate in FixFate
            if fates[fate.name.lower()]
        ],
    }


def variant_rows(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One line for the scenario itself and one for each of its variants; none without variants."""
    variants = summary.get("variants")
    if not variants:
        return []
    return [_variant("as stated", summary), *(_variant(name, variant) for name, variant in variants.items())]


def _variant(name: str, content: Mapping[str, Any]) -> dict[str, Any]:
    filters, network = content["filters"], content.get("network")
    errors = filters.get("l2linf") or dict.fromkeys(COLUMNS)
    return {
        "name": name,
        "ratios": content["paired"].get("l2linf/ekf_stamped") or dict.fromkeys(GROUPS),
        "over_bound": (filters.get("ekf_stamped") or {}).get("over_bound") or dict.fromkeys(GROUPS),
        "errors": [errors[column] for column in COLUMNS],
        "delivered": network and network["fixes_delivered"],
        "delay_ms": network["delay_ms"] if network else {"mean": None, "sd": None},
        "failed": sum(row["failed_runs"] for row in filters.values()),
    }
