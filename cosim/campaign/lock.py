"""One process at a time in a campaign's folder: a lock that ends with the process that holds it."""

import fcntl
import os
import socket
import warnings
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from ...sins.text import printable, shortened
from ..scenario import ScenarioError

_FILE = "campaign.lock"
_MOST_LETTERS = 200
"""Of what the holder says of itself."""


def locked(folder: Path) -> TextIO:
    """Take the lock of a folder: held until what is returned is closed, or the process ends, however it does.

    Its file stays where it is and says who took it last, and when; a lock that nobody holds is free. Where
    the file system knows no locks there is a warning, and no lock. Raises `ScenarioError` where another
    process holds it; OSError.
    """
    # Not through a link: what it leads to is not the folder's, and would be written over.
    handle = os.open(folder / _FILE, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    file = os.fdopen(handle, "r+", encoding="utf-8", errors="replace")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.seek(0)
        holder = shortened(printable(file.read(_MOST_LETTERS + 1).strip()), _MOST_LETTERS)
        file.close()
        told = f"{printable(str(folder))}: another process works in it"
        raise ScenarioError(f"{told}: {holder}" if holder else told) from error
    except OSError as error:
        warnings.warn(f"{folder}: no lock: {error.strerror}; let no other process work in it", stacklevel=2)
        return file
    file.truncate(0)
    file.write(
        f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n"
    )
    file.flush()
    return file
