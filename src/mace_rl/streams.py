"""One independent random stream per component, so that no component disturbs another's draws.

This is what makes β = 0 equal to plain PPO to the bit: memory, novelty and the meta network draw
from streams of their own.
"""

import numpy as np

# Order matters: a stream's place is its key. New streams go at the end.
STREAMS = (
    "environment",
    "actions",
    "minibatches",
    "actor",
    "extrinsic_critic",
    "intrinsic_critic",
    "density",
    "density_batches",
    "meta",
)


def sequence(seed: int, stream: str) -> np.random.SeedSequence:
    """The seed sequence of `stream` (one of `STREAMS`) in the run with this `seed`."""
    return np.random.SeedSequence(entropy=seed, spawn_key=(STREAMS.index(stream),))


def numpy_generator(seed: int, stream: str) -> np.random.Generator:
    """A NumPy generator for `stream`."""
    return np.random.default_rng(sequence(seed, stream))
