"""What the network needs to know of a vehicle that flies."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Truth(Protocol):
    """A vehicle's true motion as a function of time."""

    def at(self, t: Array, /) -> tuple[Array, Array, Array]:
        """``lla`` (k, 3), ``v_n`` (k, 3) and ``q_nb`` (k, 4) at times ``t`` (k,), s."""
        ...
