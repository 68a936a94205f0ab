"""β by the paper's meta-adaptation network: an LSTM that reads the last episode, and learns.

The paper (supplement): its input is "a sequence of the agent's experiences from the preceding
episode, including states, actions, and rewards" (`beta.sequence`), its output "determines the β for
the next episode", and it "is trained with its own optimizer" (`beta.network`). It names no loss:
`beta.objectives` has a family of them.
"""

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController, BetaGradient
from mace_rl.beta.network import CompiledMetaNetwork, LearningNetwork
from mace_rl.beta.objectives import Lesson, Objective, Played
from mace_rl.beta.sequence import SequenceReader
from mace_rl.beta.squash import beta_of, logit
from mace_rl.config.beta import MetaConfig
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.arrays import total


class MetaAdaptation(Stateful, BetaController):
    """Sets β for the next episode from the steps of the last one; see the module."""

    STATE = ("network", "objective", "reader", "sequence")

    def __init__(
        self,
        config: MetaConfig,
        objective: Objective,
        initial: float,
        spaces: Spaces,
        engine: str,
        generator: np.random.Generator,
    ) -> None:
        """initial: β as long as nothing has been learned."""
        self.initial_logit, self.objective = logit(initial), objective
        self.learns = objective.asks_policy
        self.reader = SequenceReader(config, spaces)
        kind: type[LearningNetwork] = CompiledMetaNetwork
        if engine == "torch":
            from mace_rl.beta.torch_network import TorchMetaNetwork as kind
        self.network = kind(config, self.reader.inputs, generator)
        self.sequence: np.ndarray | None = None  # what was read for the next β
        # What was read, o, what that added to the logit, and β.
        self.asked: tuple[np.ndarray, float, float, float] | None = None

    def next_beta(self) -> float:
        self.asked = None
        if self.sequence is None:  # the first episode's β is given
            return beta_of(self.initial_logit)
        output = self.network.output(self.sequence)
        added = self.objective.logit(output)
        beta = beta_of(self.initial_logit + added)
        self.asked = self.sequence, output, added, beta
        return beta

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        if self.asked is not None:
            played = Played(*self.asked, total(episode.rewards))
            self.take(self.objective.after_episode(played))
        self.sequence, self.asked = self.reader.read(episode, bonus), None

    def learn(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> float | None:
        credit, lesson = self.objective.after_rollout(gradient, advantage_rms, change)
        self.take(lesson)
        return credit

    def take(self, lesson: Lesson | None) -> None:
        """Let the network learn."""
        if lesson is not None:
            self.network.learn(*lesson)
