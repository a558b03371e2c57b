"""Parameters of the experiment of Wan et al."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ...network.localization.fading_ekf import PUBLISHED, FadingEkf
from ...sins.settings import Settings

_Share = Annotated[float, Field(ge=0.01, le=0.95)]
_Degree = Annotated[float, Field(ge=2, le=40)]
_LENGTHS = {
    "connectivities": (2, 8),
    "beacon_shares": (3, 12),
    "range_error_shares": (2, 12),
    "cost_nodes": (3, 12),
}


def _listed(values: tuple[float, ...]) -> str:
    return f"[{', '.join(f'{value:g}' for value in values)}]"


class Refinement(Settings):
    """Nodes at random in a square, some of them beacons, and the filter that refines where they are."""

    kind: Literal["refinement"]
    nodes: int = Field(default=200, ge=20, le=1000)
    side_m: float = Field(default=105.0, ge=1, le=1e6)
    """Of the square; the paper gives the radius of 10.7 m that makes the connectivity 6, and not this."""
    connectivities: tuple[_Degree, ...] = Field(default=(6.0, 7.0, 8.0, 9.0))
    """Neighbours of a node in the mean: in each draw the radius that makes exactly that many."""
    beacon_shares: tuple[_Share, ...] = Field(default=(0.05, 0.1, 0.2, 0.3, 0.5))
    low_share: _Share = 0.1
    high_share: _Share = 0.5
    """Shares of which the paper quotes gains: all methods are run there, and must be among the shares."""
    sweep_radius_m: float = Field(default=10.7, ge=0.1, le=1e5)
    """Fig. 5: networks of the first connectivity and the low share, scaled to this radius."""
    range_error_shares: tuple[Annotated[float, Field(ge=1e-3, le=0.5)], ...] = Field(
        default=(0.02, 0.05, 0.1, 0.15, 0.2)
    )
    """Fig. 5: standard deviations of a range, in radii."""
    judged_error_share: float = Field(default=0.05, ge=1e-3, le=0.5)
    """The one of them at which ratios to the bound and NEES are told."""
    rigid_connectivity: _Degree = 14.0
    rigid_share: _Share = 0.2
    """A network whose geometry is rigid nearly everywhere, for the bound."""
    nearest_beacons: int = Field(default=4, ge=3, le=1000)
    """By which DV-distance locates a node; the paper says three or more."""
    initial_sd_radii: float = Field(default=0.5, ge=1e-3, le=100)
    """P of the filters at the start, the root of its diagonal, in radii; as the next two ours."""
    assumed_error_radii: float = Field(default=0.01, ge=1e-4, le=1)
    """R at the start where ranges are exact."""
    process_sd_radii: float = Field(default=0.01, ge=0, le=1)
    sage_forgetting: float = Field(default=0.95, gt=0, lt=1)
    max_fading: float = Field(default=2.0, ge=1, le=1e6)
    tolerance_m: float = Field(default=0.01, gt=0, le=100)
    """Delta, as the paper has it."""
    max_steps: int = Field(default=40, ge=1, le=10_000)
    cost_nodes: tuple[Annotated[int, Field(ge=20, le=20_000)], ...] = Field(
        default=(50, 100, 200, 500, 1000, 2000)
    )
    """Networks in which messages and operations are counted, at the second connectivity and the low share."""
    dense_most: int = Field(default=200, ge=20, le=1000)
    """The largest of them in which whole matrices are worked out as well."""
    disconnected: Literal["leave_out", "refuse"] = "leave_out"
    """Parts of a network without three beacons: their nodes have no estimate, or the draw ends the run."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for name, (least, most) in _LENGTHS.items():
            values = getattr(self, name)
            if not least <= len(values) <= most:
                raise ValueError(f"{name} = {_listed(values)}: {least} to {most} values are allowed")
            if list(values) != sorted(set(values)):
                raise ValueError(f"{name} = {_listed(values)}: must increase")
        for share in sorted({*self.beacon_shares, self.low_share, self.rigid_share}):
            if round(share * self.nodes) < 3:
                raise ValueError(
                    f"beacon_shares = {share:g} makes {round(share * self.nodes)} of {self.nodes} nodes"
                    " beacons: at least 3 are needed"
                )
        for name, share in (("low_share", self.low_share), ("high_share", self.high_share)):
            if share not in self.beacon_shares:
                raise ValueError(f"{name} = {share:g} must be one of beacon_shares")
        if not any(self.low_share < share < self.high_share for share in self.beacon_shares):
            raise ValueError(
                f"beacon_shares = {_listed(self.beacon_shares)}: one must lie between low_share ="
                f" {self.low_share:g} and high_share = {self.high_share:g}"
            )
        if self.judged_error_share not in self.range_error_shares:
            raise ValueError(
                f"judged_error_share = {self.judged_error_share:g} must be one of range_error_shares"
            )
        return self

    def ekf(self, radius_m: float, range_sd_m: float) -> FadingEkf:
        """The mended filter with Q and R as they are at the start."""
        return FadingEkf(
            max_fading=self.max_fading,
            noise="fixed",
            sage_forgetting=self.sage_forgetting,
            tolerance_m=self.tolerance_m,
            max_steps=self.max_steps,
            initial_sd_m=self.initial_sd_radii * radius_m,
            range_sd_m=range_sd_m,
            process_sd_m=self.process_sd_radii * radius_m,
        )

    def published(self, radius_m: float, range_sd_m: float) -> FadingEkf:
        """The filter as printed."""
        printed = {name: getattr(PUBLISHED, name) for name in PUBLISHED.model_fields_set}
        return self.ekf(radius_m, range_sd_m).model_copy(update=printed)
