"""What a run keeps in memory grows with durations, rates and nodes: refused before it is taken."""

from ..network.fleet_network import FleetNetwork
from ..network.source import AnyFixSource, RecordedFixes

MOST_OUTPUTS = 400_000
MOST_FIXES = 400_000
MOST_NODE_EPOCHS = 4_000_000
"""In one run: some hundreds of bytes for each, times the filters and the runs in work."""


def check_sizes(duration_s: float, output_rate_hz: float, fixes: AnyFixSource) -> None:
    """Raises ValueError for an alignment of that duration that asks for more than that."""
    during = f"during alignment.duration_s = {duration_s:g} s"
    outputs = duration_s * output_rate_hz
    if outputs > MOST_OUTPUTS:
        raise ValueError(
            f"alignment.settings.output_rate_hz = {output_rate_hz:g} Hz: {outputs:.6g} outputs {during};"
            f" allowed are {MOST_OUTPUTS}"
        )
    if isinstance(fixes, RecordedFixes):
        return
    made = duration_s * fixes.rate_hz
    if isinstance(fixes, FleetNetwork) and made * fixes.fleet.nodes > MOST_NODE_EPOCHS:
        raise ValueError(
            f"fixes.rate_hz = {fixes.rate_hz:g} Hz, fixes.fleet.nodes = {fixes.fleet.nodes}:"
            f" {made * fixes.fleet.nodes:.6g} positions {during}; allowed are {MOST_NODE_EPOCHS}"
        )
    if made > MOST_FIXES:
        raise ValueError(
            f"fixes.rate_hz = {fixes.rate_hz:g} Hz: {made:.6g} fixes {during}; allowed are {MOST_FIXES}"
        )
