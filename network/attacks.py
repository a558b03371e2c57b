"""What an intruder does with packets on their way to the own ship."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.random import Generator
from pydantic import Field

from ..sins import earth
from ..sins.settings import Settings
from .authentication import Authentication, genuine, tags
from .fixes import Array, Booleans, Fixes, concatenate

Metres = Annotated[float, Field(ge=-1e6, le=1e6)]


class _Attack(Settings):
    share: float = Field(default=0.2, ge=0, le=1)
    """Of the own ship's fixes that are attacked, each by chance."""
    start_s: float = Field(default=0.0, ge=0, le=3600)
    """From the start of the alignment."""
    duration_s: float = Field(default=3600.0, ge=0.01, le=3600)


class Forgery(_Attack):
    """Packets of the intruder's own in the name of the fix's maker, with the number and the stamp of the next
    fix, just after this one. The tag is by a key of the intruder's."""

    kind: Literal["forged"] = "forged"
    offset_n_m: tuple[Metres, Metres, Metres] = (300.0, 0.0, 0.0)
    """Of the position in them from that in the fix, NED."""


class Tampering(_Attack):
    """Packets that are changed on their way, their tags left as they were."""

    kind: Literal["tampered"] = "tampered"
    offset_n_m: tuple[Metres, Metres, Metres] = (300.0, 0.0, 0.0)


class Replay(_Attack):
    """Packets that are recorded and sent again."""

    kind: Literal["replayed"] = "replayed"
    after_s: float = Field(default=3.0, ge=0.001, le=600)
    original_lost: bool = False
    """Whether the intruder jams the original."""


Attack = Annotated[Forgery | Tampering | Replay, Field(discriminator="kind")]


@dataclass(frozen=True)
class Attacked:
    """Times of arrival of the intruder's packets: truth, for scores. Nothing else arrives just then."""

    forged: Array
    """(p,) s, those that were made up or changed."""
    replayed: Array
    """(q,) s."""


def attacked(
    fixes: Fixes,
    attacks: Sequence[Attack],
    authentication: Authentication | None,
    wrong_keys: Collection[int],
    start_s: float,
    period_s: float,
    rng: Generator,
) -> tuple[Fixes, Attacked]:
    """What arrives of ``fixes``, in order of arrival, taken for genuine or not, and what is the intruder's.

    ``wrong_keys`` are nodes whose tags are by a key of their own, ``start_s`` is that of the alignment,
    ``period_s`` the time between fixes. Each attack draws from a child of ``rng``, for all fixes. Without
    ``authentication`` all packets are taken for genuine.
    """
    said, kept = fixes, np.ones(len(fixes), np.bool_)
    *children, key_rng = rng.spawn(len(attacks) + 1)
    wrong = _other_key(key_rng)
    sent = np.array([b""] * len(fixes), object)
    if authentication is not None:
        sent[:] = tags(fixes, authentication)
        astray = np.isin(fixes.source, list(wrong_keys))
        sent[astray] = tags(fixes[astray], wrong)
    others: list[tuple[Fixes, list[bytes]]] = []
    forged, replayed = [np.zeros(0)], [np.zeros(0)]
    for attack, child in zip(attacks, children, strict=True):
        at_s = fixes.t_valid - start_s
        hit = child.random(len(fixes)) < attack.share
        hit &= (at_s >= attack.start_s) & (at_s < attack.start_s + attack.duration_s)
        if isinstance(attack, Tampering):
            said = replace(said, lla=_moved(said.lla, hit, attack.offset_n_m))
            forged.append(fixes.t_arrival[hit])
        elif isinstance(attack, Forgery):
            made = fixes[hit]
            made = replace(
                made,
                t_stamp=made.t_stamp + period_s,
                t_arrival=made.t_arrival + period_s * child.random(len(made)),
                lla=_moved(made.lla, np.ones(len(made), np.bool_), attack.offset_n_m),
                sequence=made.sequence + 1,
            )
            others.append((made, tags(made, wrong)))
            forged.append(made.t_arrival)
        else:
            again = fixes[hit]
            again = replace(again, t_arrival=again.t_arrival + attack.after_s)
            others.append((again, sent[hit].tolist()))
            replayed.append(again.t_arrival)
            if attack.original_lost:
                kept &= ~hit
    parts = [(said[kept], sent[kept].tolist()), *others]
    if authentication is not None:
        parts = [(replace(part, authentic=genuine(part, its, authentication)), its) for part, its in parts]
    arrived = concatenate(part for part, _ in parts)
    return arrived, Attacked(np.concatenate(forged), np.concatenate(replayed))


def _other_key(rng: Generator) -> Authentication:
    return Authentication(key_hex=rng.bytes(32).hex())


def _moved(lla: Array, rows: Booleans, offset_n_m: tuple[float, float, float]) -> Array:
    return earth.displaced(lla, np.where(rows[:, None], offset_n_m, 0.0))
