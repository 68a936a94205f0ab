"""One independent random stream per component, so that no component disturbs another's draws.

This is what makes β = 0 equal to plain PPO to the bit: novelty and what sets β draw from streams
of their own.
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
    "meta",  # not drawn from any more
    "novelty",
    "beta",
    "bonus",
)


class Streams:
    """The random streams of the run with this `seed`."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def sequence(self, stream: str) -> np.random.SeedSequence:
        """The seed sequence of `stream`, one of `STREAMS`."""
        return np.random.SeedSequence(entropy=self.seed, spawn_key=(STREAMS.index(stream),))

    def __getitem__(self, stream: str) -> np.random.Generator:
        """A new generator for `stream`, at its beginning."""
        return np.random.default_rng(self.sequence(stream))
