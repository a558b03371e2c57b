"""Of which code results are."""

import hashlib
from functools import cache
from pathlib import Path

ROOMS = Path(__file__).parents[1]
"""The folder in which the rooms stand side by side, in the repository as in an installed package."""


@cache
def sources_digest(*patterns: str, rooms: Path = ROOMS) -> str:
    """SHA-256 of the names and the contents of the files in ``rooms`` that match any of the patterns, as they
    were when this was first asked: a process does not read its code again."""
    found = {path.relative_to(rooms).as_posix(): path for pattern in patterns for path in rooms.glob(pattern)}
    digest = hashlib.sha256()
    for name, path in sorted(found.items()):
        digest.update(name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()
