"""How training goes: what lets β follow progress and stagnation over many episodes."""

import math

import numpy as np

from mace_rl.beta.lstm import logit
from mace_rl.numerics.elementary import log
from mace_rl.state import Stateful

FAST, SLOW = 0.1, 0.02  # weights of the last return in the two moving averages
IMPROVEMENT = 0.1  # of the returns' standard deviation: less is not progress


class Progress(Stateful):
    """Moving averages of the extrinsic return, and since when they have not risen."""

    STATE = ("count", "mean", "squares", "fast", "slow", "best", "stalled")

    SIZE = 4  # of `features`

    def __init__(self) -> None:
        self.count = 0
        self.mean = self.squares = 0.0  # of all returns; sum of squared deviations
        self.fast = self.slow = self.best = 0.0  # averages of the last some 10 and 50; best fast
        self.stalled = 0  # episodes since `best`

    def update(self, extrinsic_return: float) -> None:
        """Take in the return of one more episode."""
        self.count += 1
        before = extrinsic_return - self.mean
        self.mean += before / self.count
        self.squares += before * (extrinsic_return - self.mean)
        self.fast += max(FAST, 1 / self.count) * (extrinsic_return - self.fast)
        self.slow += max(SLOW, 1 / self.count) * (extrinsic_return - self.slow)
        self.stalled += 1
        if self.count == 1 or self.fast > self.best + IMPROVEMENT * self.spread:
            self.best, self.stalled = self.fast, 0

    @property
    def spread(self) -> float:
        """The standard deviation of all returns; 0 if they were all equal."""
        return math.sqrt(self.squares / self.count) if self.squares > 0 else 0.0

    def features(self, beta: float) -> np.ndarray:
        """What the meta network reads, each about -3 to 3, float64 [SIZE].

        Progress, fast less slow average; shortfall, best less fast average, both in standard
        deviations of the return; log(1 + episodes since the best) / 2; the logit of β / 2.
        """
        unit = self.spread or 1.0
        features = (
            (self.fast - self.slow) / unit,
            (self.best - self.fast) / unit,
            log(np.float32(1 + self.stalled)) / 2,
            logit(min(max(beta, 1e-6), 1 - 1e-6)) / 2,
        )
        return np.array([min(max(float(feature), -3.0), 3.0) for feature in features])
