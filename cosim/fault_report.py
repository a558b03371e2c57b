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
    return {
        "name": name,
        "color": filter_color(name),
        "rejected": row["outliers_rejected"],
        "lost": row["good_lost"],
        "late": row["late"],
        "duplicates": row["duplicates"],
        "restarts": row["restarts"],
        "alone_s": (outage.get("dead_reckoning_after_s") or [None, None])[1],
        "nees": [_nees(part) for part in ([row, outage] if outage else [row])],
        "position_nees": outage.get("position_nees"),
        "after": outage.get("after_30_s"),
        "unflagged": row["unflagged_jumps"],
        "ratios": row["over_clean"] or {},
        "failed": row["failed_runs"],
        "why": ", ".join(f"{count} {reason}" for reason, count in row["failures"].items()),
        "imu": ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in row["imu_samples"].items()),
        "attacked": ", ".join(
            f"{kind} packets fused: {row[f'{kind}_fused']}"
            for kind in ("forged", "replayed")
            if row[f"{kind}_fused"] is not None
        ),
    }


def _nees(part: Mapping[str, Any]) -> dict[str, Any]:
    """A NEES, its band, and whether it lies outside."""
    nees, band = part["nees"], part["nees_band95"]
    outside = nees is not None and band is not None and not band[0] <= nees <= band[1]
    return {"value": nees, "band": band, "outside": outside}


def _network(found: Mapping[str, Any] | None) -> str | None:
    if not found:
        return None
    told = f"{found['lying']} nodes lied over all runs"
    if found["quarantined"] is not None:
        told += f", {100 * found['quarantined']:.1f} % of them were quarantined"
    if found["quarantined_after_s"]:
        mean, most = found["quarantined_after_s"]
        told += f" after {mean:.1f} s, {most:.1f} s at most"
    if found["quarantined_at_end"] != found["quarantined"]:
        told += f" ({100 * found['quarantined_at_end']:.1f} % at the end)"
    told += f"; {found['false_quarantines']} honest nodes were, {found['false_at_end']} at the end"
    if found["honest_suspects"]:
        at_end = found["honest_suspects_at_end"]
        told += f"; {found['honest_suspects']} stood back as suspects of a start, {at_end} at the end"
    if found["disturbed_runs"]:
        told += f"; in {found['disturbed_runs']} runs nodes contradicted each other and none could be named"
    return told


_NAME = 13
_HEADINGS = (
    ("", "outliers", "rejected", 9),
    ("good", "refused", "by gate", 9),
    ("dead", "reckoning", "after, s", 10),
    ("final", "NEES", "of 3", 6),
    ("", "unflagged", "jumps", 10),
    *((group, "over", "clean", len(group) + 1) for group in GROUPS),
)


def told_faults(summary: Mapping[str, Any]) -> list[str]:
    """A table within 80 columns: one line for each fault and filter, under the name of the fault; below it
    what else there is to tell of them."""
    lines = [" " * _NAME + "".join(f"{h[i]:>{h[-1]}}" for h in _HEADINGS) for i in range(3)]
    for block in fault_rows(summary):
        lines.append(block["name"])
        for line in block["filters"]:
            values = (
                _percent(line["rejected"]),
                _percent(line["lost"]),
                _number(line["alone_s"], 1),
                _number(line["nees"][0]["value"], 2),
                str(line["unflagged"]),
                *(_number(line["ratios"].get(group, [None])[0], 2) for group in GROUPS),
            )
            told = "".join(f"{value:>{h[-1]}}" for value, h in zip(values, _HEADINGS, strict=True))
            lines.append(f"  {line['name']}".ljust(_NAME) + told)
            lines += [f"    {more}" for more in _besides(line)]
        if block["network"]:
            lines.append(block["network"])
    return lines


def _besides(line: Mapping[str, Any]) -> list[str]:
    """What the table has no column for, where it happened."""
    told = []
    for nees in line["nees"][1:]:
        band = "" if nees["band"] is None else " (band {:.2f} to {:.2f})".format(*nees["band"])
        told.append(f"NEES at the end of the outage {_number(nees['value'], 2)} of 3{band}")
    if line["restarts"]:
        told.append(f"started again {line['restarts']} times over all runs")
    if line["attacked"]:
        told.append(line["attacked"])
    if line["failed"]:
        told.append(f"failed runs: {line['why']}")
    return told


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f} %"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
