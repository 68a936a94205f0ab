"""One independent random stream per component, so that no component disturbs another's draws.

So β = 0 equals plain PPO to the bit: memory and novelty draw from streams of their own.
"""

import numpy as np

# A stream's place here is its key, so new streams go at the end.
STREAMS = (
    *("environment", "actions", "minibatches", "actor", "extrinsic_critic", "intrinsic_critic"),
    # "density" and what follows it: of the bonus and β; "dropout" in `published` alone.
    *("density", "density_batches", "meta", "novelty", "beta", "bonus", "dropout"),
    "global",  # seeds Python's, NumPy's and PyTorch's own, from which other people's code may draw
    "exploration",  # of the β that a meta network learns from
)


class Streams:
    """The random streams of the run with this `seed`."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def sequence(self, stream: str) -> np.random.SeedSequence:
        """The seed sequence of a stream."""
        return np.random.SeedSequence(entropy=self.seed, spawn_key=(STREAMS.index(stream),))

    def __getitem__(self, stream: str) -> np.random.Generator:
        """A new generator at the stream's beginning."""
        return np.random.default_rng(self.sequence(stream))
