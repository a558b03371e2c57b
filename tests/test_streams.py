"""Generators of many effects: those that numpy would spawn."""

import numpy as np
import pytest
from fleetalign.sins.streams import Streams

NAMES = ("noise", "delay", "loss")


@pytest.mark.parametrize("made", [np.random.default_rng, lambda seed: seed])
def test_streams_are_the_children_that_numpy_spawns(made):
    def seed():
        return np.random.SeedSequence(12, spawn_key=(3, 4))

    streams = Streams(made(seed()), NAMES)
    # Asked for in another order, and one of them never.
    found = {name: streams[name].random(5) for name in ("loss", "noise")}
    for name, child in zip(NAMES, np.random.default_rng(seed()).spawn(len(NAMES)), strict=True):
        if name in found:
            np.testing.assert_array_equal(found[name], child.random(5))


def test_a_stream_goes_on_where_it_was():
    once = Streams(np.random.default_rng(1), NAMES)["noise"].random(4)
    streams = Streams(np.random.default_rng(1), NAMES)
    np.testing.assert_array_equal(np.r_[streams["noise"].random(2), streams["noise"].random(2)], once)


def test_a_generator_gives_others_the_next_time_and_a_seed_the_same():
    rng, seed = np.random.default_rng(1), np.random.SeedSequence(1)
    first, second = (Streams(rng, NAMES)["noise"].random() for _ in range(2))
    assert first != second
    assert [Streams(seed, NAMES)["noise"].random() for _ in range(2)] == [first, first]
