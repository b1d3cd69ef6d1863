"""Random numbers of compiled kernels, the same on every machine and for any number of threads."""

import numpy as np

from maplab_py.compilation import compiled


@compiled(forceinline=True)
def random_below(state, count):  # type: ignore[no-untyped-def]
    """Advance a splitmix64 generator (Steele et al., OOPSLA 2014); return a number below count.

    Args:
        state: State of the generator (1,), unsigned.
        count: How many numbers there are, at least 1.
    """
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.int64((z ^ (z >> np.uint64(31))) % np.uint64(count))
