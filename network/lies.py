"""Nodes that say what is not so: of where they are, or of how far others are."""

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..sins.settings import Settings
from .fleet import OWN_SHIP

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Speed = Annotated[float, Field(ge=-1e4, le=1e4)]
NodeNumber = Annotated[int, Field(ge=0, lt=1000)]


class Chosen(Settings):
    """Which nodes: some by their numbers, others drawn."""

    nodes: tuple[NodeNumber, ...] = Field(default=(), max_length=1000)
    anchors: int = Field(default=0, ge=0, le=1000)
    """So many anchors, drawn; at most all of them."""
    anchor_share: float = Field(default=0.0, ge=0, le=1)
    """Such a share of the anchors, drawn."""
    others: int = Field(default=0, ge=0, le=1000)
    """So many nodes that are neither anchors nor the own ship, drawn."""

    def drawn(self, anchor: Booleans, rng: Generator) -> Integers:
        """The numbers of the nodes, where ``anchor`` (n,) marks the anchors."""
        key = rng.random(len(anchor))
        blind = ~anchor
        blind[OWN_SHIP] = False
        found = [np.array(self.nodes, np.int64)]
        wanted = self.anchors + round(self.anchor_share * int(anchor.sum()))
        for rows, count in ((anchor, wanted), (blind, self.others)):
            among = np.flatnonzero(rows)
            found.append(among[np.argsort(key[among], kind="stable")[:count]])
        return np.unique(np.concatenate(found))


class _Lie(Chosen):
    start_s: float = Field(default=0.0, ge=0, le=3600)
    """From the start of the alignment; from then on to the end."""
    direction: Literal["same", "own"] = "same"
    """Whether all lie alike, or each has turned what is said by an angle about the vertical, drawn."""


class _OfPlace(_Lie):
    @model_validator(mode="after")
    def _of_anchors(self) -> Self:
        why = "only anchors say where they are"
        if self.others:
            raise ValueError(f"others = {self.others}: {why}, allowed is 0")
        if OWN_SHIP in self.nodes:
            raise ValueError(f"nodes has {OWN_SHIP}, the own ship: {why}")
        return self


class Offset(_OfPlace):
    """Anchors say that they are elsewhere, by a constant; what others say of themselves nobody asks."""

    kind: Literal["offset"] = "offset"
    offset_n_m: tuple[Metres, Metres, Metres] = (300.0, 0.0, 0.0)
    """NED."""


class Ramp(_OfPlace):
    """Anchors say that they are elsewhere, by ever more. The velocity that they say stays true."""

    kind: Literal["ramp"] = "ramp"
    ramp_n_mps: tuple[Speed, Speed, Speed] = (5.0, 0.0, 0.0)
    """NED."""


class FalseRanges(_Lie):
    """Ranges in which a node takes part are off by a constant."""

    kind: Literal["ranges"] = "ranges"
    range_m: float = Field(default=300.0, ge=-1e5, le=1e5)


Lie = Annotated[Offset | Ramp | FalseRanges, Field(discriminator="kind")]


class Lies:
    """Who lies in a run, and what. Each lie draws from a child of ``rng``; ``start_s`` is the alignment's."""

    def __init__(self, lies: Sequence[Lie], anchor: Booleans, start_s: float, rng: Generator) -> None:
        self.since_s: Array = np.full(len(anchor), np.nan)
        """(n,) s, from when on each node lies; NaN for honest ones, and so for those that are to lie of their
        place and are no anchors in this run."""
        self._told: list[tuple[Lie, float, Integers, Array]] = []
        for lie, child in zip(lies, rng.spawn(len(lies)), strict=True):
            nodes, since_s = lie.drawn(anchor, child), start_s + lie.start_s
            if isinstance(lie, _OfPlace):
                nodes = nodes[anchor[nodes]]
            angle = 2 * np.pi * child.random(len(anchor))[nodes] * (lie.direction == "own")
            turn = np.zeros((len(nodes), 3, 3))
            turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
            turn[:, 1, 0], turn[:, 2, 2] = np.sin(angle), 1.0
            turn[:, 0, 1] = -turn[:, 1, 0]
            self._told.append((lie, since_s, nodes, turn))
            self.since_s[nodes] = np.fmin(self.since_s[nodes], since_s)

    def positions_n(self, t: Array) -> Array:
        """(k, n, 3) m, what is added to the positions that anchors say, NED, at ``t`` (k,), s."""
        added = np.zeros((len(t), len(self.since_s), 3))
        for lie, since_s, nodes, turn in self._told:
            if isinstance(lie, Offset):
                added[:, nodes] += (t >= since_s)[:, None, None] * (turn @ lie.offset_n_m)
            elif isinstance(lie, Ramp):
                added[:, nodes] += np.maximum(t - since_s, 0.0)[:, None, None] * (turn @ lie.ramp_n_mps)
        return added

    def ranges(self, t: Array) -> Array:
        """(k, n) m, what is added to the ranges in which each node takes part."""
        added = np.zeros((len(t), len(self.since_s)))
        for lie, since_s, nodes, _ in self._told:
            if isinstance(lie, FalseRanges):
                added[:, nodes] += (t >= since_s)[:, None] * lie.range_m
        return added
