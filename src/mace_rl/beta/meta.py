"""β by meta-adaptation: an LSTM that has learned how to explore, and the credit of earlier βs."""

from pathlib import Path

import numpy as np

from mace_rl.beta.controller import BetaController, Effect
from mace_rl.beta.credit import Integrator, Judge
from mace_rl.beta.gauge import Gauge
from mace_rl.beta.lstm import lstm_logit, read_network
from mace_rl.config.beta import MetaConfig
from mace_rl.environments.rollout import Episode
from mace_rl.numerics.arrays import total
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import exp, log
from mace_rl.state import Stateful

WEIGHTS = Path(__file__).with_name("weights.npz")  # tools/meta made them
LARGEST_LOGIT = 6.0  # of β


class MetaAdaptation(Stateful, BetaController):
    """The logit of β is the LSTM's answer plus what the credit of earlier βs adds up to.

    The LSTM reads how the whole training went so far, window by window, and does not learn in a
    run: its weights come from many short trainings on generated tasks. The credit corrects it where
    the gradients of this training show that more or less β helps.
    """

    STATE = ("gauge", "judge", "integrator", "lstm_part")

    def __init__(self, config: MetaConfig, initial: float, episodes: int) -> None:
        """initial: β before the first window closes; episodes: the budget."""
        self.learns = config.credit_gain > 0
        self.network = read_network(WEIGHTS) if config.pretrained else None
        self.gauge, self.judge, self.integrator = Gauge(episodes), Judge(config), Integrator(config)
        self.lstm_part = logit(initial)

    @property
    def beta(self) -> float:
        """See `BetaController`."""
        return beta_of(self.lstm_part + self.integrator.logit)

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        closed = self.gauge.update(total(episode.rewards), total(bonus), len(episode))
        if closed and self.network is not None:
            self.lstm_part = float(lstm_logit(self.gauge.sequence(), self.network))

    def learn(self, gradient: np.ndarray, strength: float, effect: Effect) -> float | None:
        """See `BetaController`."""
        credit = self.judge.judge(gradient, strength, effect)
        if credit is not None:
            self.integrator.add(credit, self.gauge.progress)
        return credit


def beta_of(logit: float) -> float:
    """The β with this logit, which is bounded so that β can come back; NaN stays NaN."""
    return logistic(np.float32(min(max(logit, -LARGEST_LOGIT), LARGEST_LOGIT)))


@kernel
def logistic(x: np.float32) -> float:
    """1 / (1 + e⁻ˣ), float64."""
    return 1 / (1 + np.float64(exp(-x)))


@kernel
def logit(beta: float) -> float:
    """log(β / (1 - β)), of a float64 in (0, 1), to float32's rounding."""
    return log(np.float32(beta / (1 - beta)))
