"""β by an LSTM that was trained beforehand, and by what corrects it in a run: ours alone."""

from pathlib import Path

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController, BetaGradient
from mace_rl.beta.credit import Integrator, Judge
from mace_rl.beta.gauge import Gauge
from mace_rl.beta.lstm import lstm_output, read_network
from mace_rl.beta.squash import beta_of, logit
from mace_rl.config.beta import PretrainedConfig
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import total

WEIGHTS = Path(__file__).with_name("weights.npz")  # tools/meta made them


class PretrainedLSTM(Stateful):
    """Reads how the whole training went so far, window by window, and does not learn in a run.

    Its weights come from many short trainings on generated tasks.
    """

    STATE = ("gauge", "logit")

    def __init__(self, initial: float, episodes: int, answers: bool = True) -> None:
        """initial: β before the first window closes; episodes: the budget; answers: or it stays."""
        self.network = read_network(WEIGHTS) if answers else None
        self.gauge, self.logit = Gauge(episodes), logit(initial)

    def read(self, episode: Episode, bonus: np.ndarray) -> None:
        """Take in one more episode; at the end of a window `logit` is what it says of β."""
        closed = self.gauge.update(total(episode.rewards), total(bonus), len(episode))
        if closed and self.network is not None:
            self.logit = float(lstm_output(self.gauge.sequence(), self.network))


class PretrainedAdaptation(Stateful, BetaController):
    """The logit of β is the LSTM's answer plus what the credit of earlier βs adds up to.

    The credit corrects it where the gradients of this training show that more or less β helps.
    """

    STATE = ("lstm", "judge", "integrator")

    def __init__(self, config: PretrainedConfig, initial: float, episodes: int) -> None:
        """initial, episodes: of `PretrainedLSTM`."""
        self.learns = config.credit_gain > 0
        self.lstm = PretrainedLSTM(initial, episodes, config.lstm)
        self.judge, self.integrator = Judge(config), Integrator(config)

    @property
    def beta(self) -> float:
        """See `BetaController`."""
        return beta_of(self.lstm.logit + self.integrator.logit)

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.lstm.read(episode, bonus)

    def learn(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> float | None:
        """See `BetaController`."""
        credit = self.judge.judge(gradient, advantage_rms, change)
        if credit is not None:
            self.integrator.add(credit, self.lstm.gauge.progress)
        return credit
