"""Tables of papers, as a scenario states them."""

from pydantic import Field

from ..sins.settings import Settings


class PaperRow(Settings):
    """One line of a published table."""

    roll_arcsec: float = Field(ge=0, le=1e6)
    pitch_arcsec: float = Field(ge=0, le=1e6)
    heading_arcmin: float = Field(ge=0, le=1e5)
    v_east_mps: float = Field(ge=0, le=1e3)
    v_north_mps: float = Field(ge=0, le=1e3)


class Paper(Settings):
    """A published table to stand beside ours, and what can be said of the two."""

    source: str
    remarks: tuple[str, ...] = ()
    ekf: PaperRow
    l2linf: PaperRow
