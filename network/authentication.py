"""Packets that prove who made them: a tag by a key that the own ship shares with each node.

The tag is BLAKE2b, keyed, over all that a packet says: source, number, stamp, position, velocity, covariance.
Whoever has no key cannot make one, nor change a packet and keep it. A packet that was recorded and is sent
again has a good tag, but not a recent stamp. Numbers betray copies of packets that the own ship has had; one
that never came, or came before it listened, is betrayed by its age alone, and so packets beyond an age are
refused. For that, clocks need to agree to a fraction of that age only. A stamp from the future would make a
packet last for longer, and is refused, too.
"""

import hashlib
import hmac
import struct
from collections.abc import Sequence
from functools import cache
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from ..sins.settings import Settings
from .fixes import Booleans, Fixes

TAG_BYTES = 16
FUTURE_S = 1e-3
"""By which a stamp may lie ahead of the arrival: clocks of nodes that range each other agree to far less."""
_SALT = b"fleetalign fix keys"


class Authentication(Settings):
    """Keys of the network, and how old a packet may be. One of `passphrase` and `key_hex` is needed."""

    passphrase: str = Field(default="", max_length=1000)
    """From which the network's key is derived, by scrypt."""
    key_hex: str = Field(default="", pattern=r"^([0-9a-fA-F]{2}){0,64}$")
    """The network's key itself, 16 to 64 bytes, as hexadecimal digits."""
    fresh_s: float = Field(default=0.2, ge=0.01, le=60)
    """Age by its stamp, on arrival, beyond which a packet is taken for a recorded one and refused."""

    @model_validator(mode="after")
    def _one_key(self) -> Self:
        if bool(self.passphrase) == bool(self.key_hex):
            told = "both are given" if self.passphrase else "neither is given"
            raise ValueError(f"passphrase, key_hex: {told}; allowed is one of them")
        if self.key_hex and len(self.key_hex) < 32:
            raise ValueError(f"key_hex = {len(self.key_hex)} digits: allowed are 32 to 128")
        return self

    def key(self, node: int) -> bytes:
        """The key of a node, from the network's."""
        if self.key_hex:
            return _node_key(bytes.fromhex(self.key_hex), node)
        return _node_key(_stretched(self.passphrase), node)


@cache
def _stretched(passphrase: str) -> bytes:
    """Slow by intent, some 50 ms: whoever guesses passphrases has to do it for each."""
    return hashlib.scrypt(passphrase.encode(), salt=_SALT, n=2**14, r=8, p=1, dklen=64)


def _node_key(key: bytes, node: int) -> bytes:
    return hashlib.blake2b(struct.pack("<q", node), key=key, person=b"node key").digest()


def tags(fixes: Fixes, authentication: Authentication) -> list[bytes]:
    """The tag of each packet, by the key of the node that it names as its source."""
    keys = {node: authentication.key(node) for node in np.unique(fixes.source).tolist()}
    numbers = np.stack([fixes.source, fixes.sequence], axis=-1).astype("<i8")
    covs = fixes.cov.reshape(len(fixes), 36)
    content = np.hstack([fixes.t_stamp[:, None], fixes.lla, fixes.v_n, covs]).astype("<f8")
    return [
        hashlib.blake2b(
            number.tobytes() + told.tobytes(), key=keys[int(number[0])], digest_size=TAG_BYTES
        ).digest()
        for number, told in zip(numbers, content, strict=True)
    ]


def genuine(fixes: Fixes, received: Sequence[bytes], authentication: Authentication) -> Booleans:
    """(k,) packets whose tag is right, and that are by their stamps no older than they may be, nor from the
    future (`FUTURE_S`)."""
    right = [hmac.compare_digest(a, b) for a, b in zip(tags(fixes, authentication), received, strict=True)]
    age = fixes.t_arrival - fixes.t_stamp
    return np.array(right, np.bool_) & (age <= authentication.fresh_s) & (age >= -FUTURE_S)
