"""β by a pretrained LSTM, and by what the credits of earlier βs add up to."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, NonNegativeFloat

from extras.pretrained.gauge import Gauge
from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController, BetaGradient
from mace_rl.beta.credit import Judge
from mace_rl.beta.lstm import lstm_output, read_network
from mace_rl.beta.squash import beta_of, logit
from mace_rl.config.beta import CreditConfig
from mace_rl.config.section import check
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import total

WEIGHTS = Path(__file__).with_name("weights.npz")  # `python -m extras.pretrained` made them


class Settings(CreditConfig):
    """The arguments of `Pretrained`."""

    initial: float = Field(gt=0, lt=1)  # β of the first hundredth of the training
    lstm: bool  # false: none, in whose place stands the initial β
    credit_gain: NonNegativeFloat  # of β's logit per unit of z beyond the threshold; 0: no credit
    credit_threshold: NonNegativeFloat  # of |z|, the sum of the credits in units of its noise


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


class Integrator(Stateful):
    """Adds up n credits c, and moves β's logit once they say more than chance would.

    z = Σc / √max(Σc², N / 2) is the sum in units of its noise, N the number of credits that the
    whole training will have. At the end it is about standard normal if β changed nothing; earlier
    it is smaller, so that β does not wander. Below the threshold the logit stays; beyond it
    follows z.
    """

    STATE = ("count", "expected", "sum", "squares")

    def __init__(self, config: Settings) -> None:
        self.gain, self.threshold = config.credit_gain, config.credit_threshold
        self.count, self.expected, self.sum, self.squares = 0, 0.0, 0.0, 0.0

    def add(self, credit: float, progress: float) -> None:
        """Take in one more credit; progress: the share of the training that is over, above 0."""
        self.count += 1
        self.expected = self.count / progress
        self.sum += credit
        self.squares += credit * credit

    @property
    def logit(self) -> float:
        """What the credits add to the logit of β."""
        if self.count == 0:
            return 0.0
        z = self.sum / math.sqrt(max(self.squares, self.expected / 2))
        return math.copysign(self.gain * max(abs(z) - self.threshold, 0.0), z)


class Pretrained(Stateful, BetaController):
    """The logit of β is the LSTM's answer plus what the credit of earlier βs adds up to.

    The credit corrects it where the gradients of this training show that more or less β helps.
    Raises `ConfigError` for arguments that are not as `Settings` has them.
    """

    STATE = ("lstm", "judge", "integrator")
    needs_budget = True

    def __init__(self, generator: np.random.Generator, episodes: int, **arguments: Any) -> None:
        """episodes: of the run; nothing is drawn."""
        settings = check(Settings, arguments, "arguments")
        self.learns = settings.credit_gain > 0
        self.lstm = PretrainedLSTM(settings.initial, episodes, settings.lstm)
        self.judge, self.integrator = Judge(settings), Integrator(settings)

    def next_beta(self) -> float:
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
