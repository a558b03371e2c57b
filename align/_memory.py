"""Arrays that the compiled loops of alignment work in; made here, since array creation is slow to compile."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from ._kernels import N_X


def working_memory(n_fixes, kept, n_states):
    """Those of `_alignment_kernel.align`: state, ``kept`` states, bookkeeping of the fixes, the navigation
    without the latest, and steps' own; for one record, or for one after the other."""
    return (
        np.zeros(N_X),
        np.zeros((n_states, n_states)),
        np.zeros((kept, N_X)),
        np.zeros((kept, n_states, n_states)),
        np.zeros(n_fixes, np.int64),
        np.zeros(n_fixes, np.int64),
        np.zeros(n_fixes, np.bool_),
        np.zeros(n_fixes, np.int64),
        (np.zeros(N_X), np.zeros(n_states), np.zeros(n_states)),
        *steps_memory(n_states),
    )


def steps_memory(n_states):
    """Those of the steps of `align._kernels`: outputs of `kinematics`, the innovation, and what
    `predict` and `update` take as ``work`` and ``buffers``."""
    predicting = ((9, 15), (9, n_states), (3, 3), 6, 6, 3, n_states)
    updating = ((6, n_states), (n_states, 6), (6, 6), (6, 6), (n_states, 6), (n_states, 6))
    updating = (*updating, (n_states, n_states), n_states)
    moving = ((3, 3), 3, 3, (2, 3), 6)
    return (
        tuple(np.zeros(shape) for shape in moving),
        np.zeros(6),
        tuple(np.zeros(shape) for shape in predicting),
        tuple(np.zeros(shape) for shape in updating),
    )
