"""Random numbers of many effects from one source: a generator for each, made when its effect is at work."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence


class Streams:
    """The generators that ``rng.spawn(len(names))`` makes, by name; of a `SeedSequence`, those that
    ``default_rng(rng)`` would spawn first.

    A generator takes as long to make as thousands of numbers to draw, and effects at rest need none. A
    generator counts what it has spawned; a seed sequence is left as it is, and gives the same again.
    """

    def __init__(self, rng: Generator | SeedSequence, names: Sequence[str]) -> None:
        self._names = names
        self._parent, self._children = rng, dict[str, SeedSequence]()
        if isinstance(rng, Generator):
            seeds: Any = rng.bit_generator.seed_seq
            self._children = dict(zip(names, seeds.spawn(len(names)), strict=True))
        self._made: dict[str, Generator] = {}

    def __getitem__(self, name: str) -> Generator:
        if name not in self._made:
            self._made[name] = self._generator(name)
        return self._made[name]

    def _generator(self, name: str) -> Generator:
        if isinstance(self._parent, Generator):
            return np.random.Generator(type(self._parent.bit_generator)(self._children[name]))
        key = (*self._parent.spawn_key, self._names.index(name))
        pool = self._parent.pool_size
        return np.random.default_rng(SeedSequence(self._parent.entropy, spawn_key=key, pool_size=pool))
