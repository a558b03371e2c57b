"""The table of faults, on the terminal and in the report."""

from collections.abc import Mapping
from typing import Any

from .palette import filter_color
from .score import GROUPS


def fault_rows(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each fault of the block ``faults`` of `summary.json` its name, what it is judged against, a line
    for each filter, and a sentence on the network; none without such a block."""
    return [
        {
            "name": name,
            "against": block["against"],
            "filters": [_line(filter_name, row) for filter_name, row in block["filters"].items()],
            "network": _network(block.get("network")),
        }
        for name, block in summary.get("faults", {}).items()
    ]


def _line(name: str, row: Mapping[str, Any]) -> dict[str, Any]:
    outage = row["outages"][0] if row["outages"] else {}
    band, nees = outage.get("nees_band95"), outage.get("nees")
    return {
        "name": name,
        "color": filter_color(name),
        "rejected": row["outliers_rejected"],
        "lost": row["good_lost"],
        "late": row["late"],
        "duplicates": row["duplicates"],
        "alone_s": (outage.get("dead_reckoning_after_s") or [None, None])[1],
        "nees": nees,
        "band": band,
        "outside": nees is not None and band is not None and not band[0] <= nees <= band[1],
        "position_nees": outage.get("position_nees"),
        "after": outage.get("after_30_s"),
        "unflagged": row["unflagged_jumps"],
        "ratios": row["over_clean"] or {},
        "failed": row["failed_runs"],
        "why": ", ".join(f"{count} {reason}" for reason, count in row["failures"].items()),
        "imu": ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in row["imu_samples"].items()),
        "forged": row["forged_fused"] + row["replayed_fused"],
    }


def _network(found: Mapping[str, Any] | None) -> str | None:
    if not found:
        return None
    told = f"{found['lying']} nodes lied over all runs"
    if found["quarantined"] is not None:
        told += f", {100 * found['quarantined']:.1f} % of them were quarantined"
    if found["quarantined_after_s"]:
        mean, most = found["quarantined_after_s"]
        told += f" after {mean:.1f} s, {most:.1f} s at most"
    return f"{told}; {found['false_quarantines']} honest nodes were"


_NAME = 13
_HEADINGS = (
    ("outliers", "rejected", 9),
    ("good", "lost", 7),
    ("alone", "at s", 6),
    ("NEES", "of 3", 5),
    ("jumps", "untold", 7),
    *((group, "ratio", len(group) + 1) for group in GROUPS),
    ("failed", "runs", 7),
)


def told_faults(summary: Mapping[str, Any]) -> list[str]:
    """A table within 80 columns: one line for each fault and filter, under the name of the fault."""
    lines = [" " * _NAME + "".join(f"{heading[i]:>{heading[2]}}" for heading in _HEADINGS) for i in (0, 1)]
    for block in fault_rows(summary):
        lines.append(block["name"])
        for line in block["filters"]:
            values = (
                _percent(line["rejected"]),
                _percent(line["lost"]),
                _number(line["alone_s"], 1),
                _number(line["nees"], 2),
                str(line["unflagged"]),
                *(_number(line["ratios"].get(group, [None])[0], 2) for group in GROUPS),
                str(line["failed"]),
            )
            told = "".join(f"{value:>{h[2]}}" for value, h in zip(values, _HEADINGS, strict=True))
            lines.append(f"  {line['name']}".ljust(_NAME) + told)
        if block["network"]:
            lines.append(block["network"])
    return lines


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f} %"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
