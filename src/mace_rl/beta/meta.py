"""β by the paper's meta-adaptation network: an LSTM that reads the last episode, and learns.

The paper (supplement): its input is "a sequence of the agent's experiences from the preceding
episode, including states, actions, and rewards", its output "determines the β for the next
episode", and it "is trained with its own optimizer". It names no loss. Ours, -c o + λ o² / 2, is in
`beta.network`: o is the output, c the credit of its β (`beta.credit`), what a little more of that
β did to the extrinsic return.
"""

import math
from collections import deque

import numpy as np
from gymnasium.spaces import Discrete

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController, BetaGradient
from mace_rl.beta.credit import Judge
from mace_rl.beta.network import CompiledMetaNetwork, LearningNetwork, TorchMetaNetwork
from mace_rl.beta.squash import beta_of, logit, natural_log
from mace_rl.config.beta import MetaConfig
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.normaliser import RunningNormaliser, standardised

CLIP = 5.0  # bound of what the LSTM reads, in standard deviations
SIZE_DECAY = 0.99  # of the running mean that says how large outputs usually are, per credit


class MetaAdaptation(Stateful, BetaController):
    """Sets β for the next episode from the steps of the last one; see the module."""

    STATE = (
        *("network", "evidence", "judge", "normaliser"),
        *("source", "sources", "judged"),
    )
    learns = True

    def __init__(
        self,
        config: MetaConfig,
        initial: float,
        spaces: Spaces,
        engine: str,
        generator: np.random.Generator,
    ) -> None:
        """initial: β as long as nothing has been learned."""
        self.config, self.initial_logit = config, logit(initial)
        self.actions = spaces.action_size if isinstance(spaces.action_space, Discrete) else 0
        inputs = spaces.observation_size + spaces.action_size + 2
        kind = CompiledMetaNetwork if engine == "compiled" else TorchMetaNetwork
        self.network: LearningNetwork = kind(config, inputs, generator)
        self.judge, self.evidence = Judge(config), Evidence(config)
        self.normaliser = RunningNormaliser(inputs)  # of what the LSTM reads
        # What was read for β: of the next episode, None before the first; of each since the last
        # update, with its output; of each rollout whose β is being judged, with the mean output.
        self.source: np.ndarray | None = None
        self.sources: list[tuple[np.ndarray, float]] = []
        self.judged: deque[tuple[list[np.ndarray], float]] = deque()
        self.known: float | None = None  # the output for `source`, once somebody has asked

    @property
    def beta(self) -> float:
        """See `BetaController`."""
        return beta_of(self.initial_logit + self.correction)

    @property
    def correction(self) -> float:
        """What the network, as it is now, adds to β's logit; 0 before it has read an episode."""
        return 0.0 if self.source is None else self.evidence.logit(self.output(self.source))

    def output(self, source: np.ndarray) -> float:
        """The network's for `self.source`, which it is asked once until it learns."""
        if self.known is None:
            self.known = self.network.output(source)
        return self.known

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        if self.source is not None:
            self.sources.append((self.source, self.output(self.source)))
        self.source, self.known = self.read(episode, bonus), None

    def read(self, episode: Episode, bonus: np.ndarray) -> np.ndarray:
        """What the LSTM reads of an episode, float32 [at most `chunks`, in].

        The episode is cut into equal stretches. Each row has their mean observation, action
        (one-hot if Discrete), reward and bonus, standardised by all rows so far.
        """
        if not self.config.reads:
            return np.zeros((1, len(self.normaliser.mean)), np.float32)
        actions = episode.actions
        if self.actions:
            actions = np.eye(self.actions, dtype=np.float32)[actions]
        seen = episode.observations.shape[1]
        rows = stretches(episode.observations, actions, episode.rewards, bonus, self.config.chunks)
        self.normaliser.update(rows)
        found = standardised(rows, self.normaliser.mean, self.normaliser.std, CLIP)
        found[:, :seen] /= np.float32(math.sqrt(seen))  # so that many weigh no more than few
        return found

    def learn(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> float | None:
        """See `BetaController`."""
        credit = self.judge.judge(gradient, advantage_rms, change)
        several = len(self.sources) > self.config.sequences
        chosen = self.sources
        if several:
            places = np.arange(self.config.sequences) * len(chosen) // self.config.sequences
            chosen = [chosen[place] for place in places]
        mean_output = sum(output for _, output in chosen) / max(len(chosen), 1)
        self.judged.append(([sequence for sequence, _ in chosen], mean_output))
        self.sources = []
        if credit is None:
            return None
        sequences, output = self.judged.popleft()
        if sequences:  # the first episode's β was given
            self.evidence.add(credit, output)
            self.network.learn(sequences, credit)
            self.known = None
        return credit


class Evidence(Stateful):
    """Whether the outputs o, before their credits c came, had the right sign.

    S = Σ c u, with u the output in units of its usual size, at most 1. Each u is known before its
    c, so S has mean 0 if β changes nothing, whatever the network has learned from noise. Its
    variance is V = Σ (c u)². Only what is beyond Robbins' bound (1970) moves β: chance crosses that
    in a given share of all trainings, however long they are.
    """

    STATE = ("sum", "variance", "size", "weight")

    def __init__(self, config: MetaConfig) -> None:
        self.config = config
        self.sum, self.variance = 0.0, 0.0
        self.size, self.weight = 0.0, 0.0  # running sum of o², and of the weights in it

    def unit(self, output: float) -> float:
        """u; NaN stays NaN."""
        if not self.size:
            return 0.0 * output
        return min(max(output / math.sqrt(self.size / self.weight), -1.0), 1.0)

    def add(self, credit: float, output: float) -> None:
        """Take in one more credit, of the output that set its β."""
        term = credit * self.unit(output)
        self.sum += term
        self.variance += term**2
        self.size = SIZE_DECAY * self.size + output**2
        self.weight = SIZE_DECAY * self.weight + 1

    @property
    def beyond_chance(self) -> float:
        """How far S is beyond the bound, in standard deviations; 0 if it is not.

        The bound is √((V + ρ) (2 ln 1/α + ln (V + ρ)/ρ)): S crosses it, above or below, with
        probability α at most.
        """
        known, chance = self.variance + self.config.evidence_scale, self.config.evidence_chance
        bound = 2 * natural_log(1 / chance) + natural_log(known / self.config.evidence_scale)
        return max(self.sum / math.sqrt(known) - math.sqrt(bound), 0.0)

    def logit(self, output: float) -> float:
        """What `output` adds to β's logit."""
        if not self.config.trusts_evidence:
            return output
        return self.config.gain * self.beyond_chance * self.unit(output)


@kernel
def stretches(observations, actions, rewards, bonus, most):
    """Means over `most` equal stretches of an episode of T steps, or its steps if it has fewer.

    observations: [T + 1, observation], the last of which is not read; actions: [T, actions];
    rewards, bonus: [T]. Float64 [stretches, observation + actions + 2].
    """
    steps, seen = len(rewards), observations.shape[1]
    count, size = min(most, steps), seen + actions.shape[1]
    result = np.zeros((count, size + 2))
    for k in range(count):
        first, end = k * steps // count, (k + 1) * steps // count
        row = result[k]
        for t in range(first, end):
            for i in range(seen):
                row[i] += observations[t, i]
            for i in range(actions.shape[1]):
                row[seen + i] += actions[t, i]
            row[size] += rewards[t]
            row[size + 1] += bonus[t]
        for i in range(size + 2):
            row[i] /= end - first
    return result
