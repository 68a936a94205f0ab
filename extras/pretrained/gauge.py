"""What the pretrained LSTM reads of a training: returns and bonus, window after window."""

import math

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.numerics.elementary import log

WINDOWS = 100  # of a training, each as many episodes
TREND = 5  # windows back with which the bonus is compared
SMALLEST_SPAN, LARGEST_SPAN = 0.01, 100.0  # of returns, in reward: nothing seen yet; much


class Gauge(Stateful):
    """Five features of each window, about -4 to 4, which mean the same in every task.

    A window closes with every hundredth of the budget, or with every episode if there are fewer.
    """

    STATE = ("count", "worst", "best", "open", "levels", "windows")

    SIZE = 5  # of a window's features

    def __init__(self, episodes: int) -> None:
        """episodes: the budget."""
        self.episodes = episodes
        self.count = 0
        self.worst, self.best = math.inf, -math.inf  # return of an episode so far
        self.open = [0.0, 0.0, 0.0, 0.0]  # this window's episodes, returns, bonus, steps
        self.levels: list[float] = []  # log₁₀ of the bonus per step, of each window that closed
        self.windows: list[list[float]] = []  # the features of these

    def update(self, extrinsic_return: float, bonus: float, steps: int) -> bool:
        """Take in an episode, with the sum of its bonus; whether its window is closed with it."""
        self.count += 1
        self.worst = min(self.worst, extrinsic_return)
        self.best = max(self.best, extrinsic_return)
        added = (1, extrinsic_return, bonus, steps)
        self.open = [before + value for before, value in zip(self.open, added, strict=True)]
        if self.count * WINDOWS < (len(self.windows) + 1) * self.episodes:
            return False
        self.windows.append(self.features())
        self.open = [0.0, 0.0, 0.0, 0.0]
        return True

    @property
    def progress(self) -> float:
        """The share of the budget that has been played."""
        return self.count / self.episodes

    def features(self) -> list[float]:
        """Of the window that closes now.

        Progress through the budget, from -1 to 1; the mean return on the way from the worst to the
        best so far; how far apart these are, as a logarithm from -1 to 1; the bonus per step, in
        powers of ten, relative to the first window's; and relative to some windows ago.
        """
        episodes, returns, bonus, steps = self.open
        level = log10(max(bonus / steps, 1e-6))
        self.levels.append(level)
        before = self.levels[max(len(self.levels) - 1 - TREND, 0)]
        span = self.best - self.worst
        return [
            2 * self.progress - 1,
            (returns / episodes - self.worst) / max(span, 0.1),
            log10(min(max(span, SMALLEST_SPAN), LARGEST_SPAN)) / 2,
            max(level - self.levels[0], -4.0),
            min(max(level - before, -1.0), 1.0),
        ]

    def sequence(self) -> np.ndarray:
        """All windows so far, float32 [windows, SIZE]."""
        return np.array(self.windows, np.float32).reshape(-1, self.SIZE)


def log10(x: float) -> float:
    """log₁₀ x, to float32's rounding, with equal bits on every processor."""
    return float(log(np.float32(x))) / math.log(10)
