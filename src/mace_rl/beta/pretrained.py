"""β by an LSTM that was trained beforehand, and the credit of earlier βs: ours, not the paper's."""

from pathlib import Path

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController, BetaGradient
from mace_rl.beta.credit import Integrator, Judge
from mace_rl.beta.gauge import Gauge
from mace_rl.beta.lstm import lstm_logit, read_network
from mace_rl.beta.squash import beta_of, logit
from mace_rl.config.beta import PretrainedConfig
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import total

WEIGHTS = Path(__file__).with_name("weights.npz")  # tools/meta made them


class PretrainedAdaptation(Stateful, BetaController):
    """The logit of β is the LSTM's answer plus what the credit of earlier βs adds up to.

    The LSTM reads how the whole training went so far, window by window, and does not learn in a
    run: its weights come from many short trainings on generated tasks. The credit corrects it where
    the gradients of this training show that more or less β helps.
    """

    STATE = ("gauge", "judge", "integrator", "lstm_part")

    def __init__(self, config: PretrainedConfig, initial: float, episodes: int) -> None:
        """initial: β before the first window closes; episodes: the budget."""
        self.learns = config.credit_gain > 0
        self.network = read_network(WEIGHTS) if config.lstm else None
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

    def learn(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> float | None:
        """See `BetaController`."""
        credit = self.judge.judge(gradient, advantage_rms, change)
        if credit is not None:
            self.integrator.add(credit, self.gauge.progress)
        return credit
