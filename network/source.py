"""Sources of fixes: stated noise and delay, a recording, or the fleet's network (`fleet_network`)."""

from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from ..sins import earth
from ..sins.settings import Settings
from ..sins.streams import Streams
from ..sins.units import MILLISECOND
from .delay import Delay, UniformDelay
from .fixes import Fixes, FixesError, concatenate, read_fixes
from .fleet_network import FleetNetwork
from .tables import DataFile, TableError
from .truth import Truth

Array = NDArray[np.float64]

# One child generator each, in this order: a new effect joins at the end, so that old draws stay.
_EFFECTS = ("noise", "delay", "loss", "duplicates", "duplicate_delay", "order", "stamp")


class FixSource(Settings):
    """Simulated fixes: white noise, one of the delay models, and a channel that loses and repeats."""

    kind: Literal["simulated"] = "simulated"
    node: int = Field(default=0, ge=0, le=2**31)
    """The node that the fixes name as their source."""
    rate_hz: float = Field(default=10.0, ge=0.01, le=1000)
    position_sd_m: float = Field(default=10.0, ge=1e-3, le=1e5)
    """Standard deviation of each component (NED)."""
    velocity_sd_mps: float = Field(default=0.1, ge=1e-4, le=1e3)
    delay: Delay = UniformDelay()
    loss_probability: float = Field(default=0.0, ge=0, le=1)
    """A lost packet never arrives, nor does its duplicate."""
    duplicate_probability: float = Field(default=0.0, ge=0, le=1)
    """A duplicate travels with a delay of its own."""
    out_of_order_probability: float = Field(default=0.0, ge=0, le=1)
    """Share of packets that take a detour, which adds a delay uniform from 0 to `out_of_order_max_s`."""
    out_of_order_max_s: float = Field(default=1.0, ge=0, le=60)
    stamp_sd_ms: float = Field(default=0.0, ge=0, le=1e4)
    """White error of the sender's clock in the stamps."""

    @property
    def delay_mean_s(self) -> float:
        """Mean delay of the first copies of packets, detours included."""
        return self.delay.mean_s + 0.5 * self.out_of_order_probability * self.out_of_order_max_s

    @property
    def delay_sd_s(self) -> float:
        """Standard deviation of the delay of the first copies of packets, detours included."""
        p, longest = self.out_of_order_probability, self.out_of_order_max_s
        detour_variance = p * longest**2 / 3 - (0.5 * p * longest) ** 2
        return float(np.sqrt(self.delay.sd_s**2 + detour_variance))


class RecordedFixes(Settings):
    """Fixes replayed from a file, see `read_fixes`; its times are on the simulation's clock."""

    kind: Literal["replay"] = "replay"
    file: DataFile

    @model_validator(mode="after")
    def _readable(self) -> Self:
        # Read once, here, so that a mistake shows when the scenario is read.
        if not len(self.recorded):
            raise TableError(self.file, "no rows")
        return self

    @cached_property
    def recorded(self) -> Fixes:
        """All fixes of the file."""
        return read_fixes(self.file)

    @property
    def delay_mean_s(self) -> float:
        """Mean delay of the recorded packets."""
        return float(np.mean(self.recorded.t_arrival - self.recorded.t_valid))

    @property
    def delay_sd_s(self) -> float:
        """Standard deviation of the delay of the recorded packets."""
        return float(np.std(self.recorded.t_arrival - self.recorded.t_valid))


def _kind(source: Any) -> str:
    """The tag of a source's settings; a table without one is a simulated source."""
    if isinstance(source, dict):
        return source.get("kind", "simulated")
    # What is no table at all is refused as a simulated source.
    return getattr(source, "kind", "simulated")


AnyFixSource = Annotated[
    Annotated[FixSource, Tag("simulated")]
    | Annotated[RecordedFixes, Tag("replay")]
    | Annotated[FleetNetwork, Tag("network")],
    Discriminator(_kind),
]
"""Any source, chosen by ``kind``; ``"simulated"`` need not be said."""


def draw_fixes(
    truth: Truth,
    start_s: float,
    end_s: float,
    settings: FixSource | RecordedFixes,
    rng: Generator | SeedSequence,
) -> Fixes:
    """Fixes that are valid from ``start_s`` to ``end_s``, in order of arrival.

    The first fix is valid at ``start_s``; late ones may arrive after ``end_s``. ``rng`` is spawned once for
    each effect, whether or not it is at work, and one at work is drawn for every packet sent: switching one
    on leaves the draws of the others as they were. A recording is cut to the interval and uses neither
    ``truth`` nor ``rng``.

    Raises `FixesError` for an interval that ends before it starts.
    """
    if not start_s <= end_s:
        raise FixesError(f"fixes from {start_s:g} s to {end_s:g} s: the end is before the start")
    if isinstance(settings, RecordedFixes):
        recorded = settings.recorded
        return recorded[(recorded.t_valid >= start_s) & (recorded.t_valid <= end_s)]

    rngs = Streams(rng, _EFFECTS)
    # The small part lets a last fix count that falls on end_s but for rounding.
    k = int(np.floor((end_s - start_s) * settings.rate_hz + 1e-6)) + 1
    t_valid = np.minimum(start_s + np.arange(k) / settings.rate_hz, end_s)
    lla, v_n, _ = truth.at(t_valid)
    sd = np.repeat([settings.position_sd_m, settings.velocity_sd_mps], 3)
    noise = sd * rngs["noise"].standard_normal((k, 6))

    delay = settings.delay.draw(k, rngs["delay"])
    if settings.out_of_order_probability > 0:
        detour = settings.out_of_order_max_s * rngs["order"].random(k)
        delay = delay + np.where(rngs["order"].random(k) < settings.out_of_order_probability, detour, 0.0)
    t_stamp = t_valid.copy()
    if settings.stamp_sd_ms > 0:
        t_stamp = t_valid + settings.stamp_sd_ms * MILLISECOND * rngs["stamp"].standard_normal(k)
    sent = Fixes(
        t_valid=t_valid,
        t_stamp=t_stamp,
        t_arrival=t_valid + delay,
        lla=earth.displaced(lla, noise[:, :3]),
        v_n=v_n + noise[:, 3:],
        cov=np.tile(np.diag(sd**2), (k, 1, 1)),
        source=np.full(k, settings.node, dtype=np.int64),
        sequence=np.arange(k, dtype=np.int64),
    )

    if settings.loss_probability == settings.duplicate_probability == 0:
        return sent.sorted_by_arrival()
    received = rngs["loss"].random(k) >= settings.loss_probability
    repeated = received & (rngs["duplicates"].random(k) < settings.duplicate_probability)
    again = t_valid + settings.delay.draw(k, rngs["duplicate_delay"])
    duplicates = replace(sent, t_arrival=again)[repeated]
    return concatenate([sent[received], duplicates])
