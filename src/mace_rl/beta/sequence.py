"""What the meta-adaptation network reads: the steps of the last episode.

The paper (supplement): "a sequence of the agent's experiences from the preceding episode, including
states, actions, and rewards". With the bonus of each step ("curiosity effectiveness", method
section), cut into stretches, so that a long episode is no longer to read than a short one.
"""

import math

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.config.beta import MetaConfig
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.normaliser import RunningNormaliser, standardised

CLIP = 5.0  # bound of what is read, in standard deviations


class SequenceReader(Stateful):
    """Makes an episode a sequence for the LSTM."""

    STATE = ("normaliser",)

    def __init__(self, config: MetaConfig, spaces: Spaces) -> None:
        self.config = config
        self.actions = spaces.action_size if spaces.actions.discrete else 0
        self.inputs = spaces.observation_size + spaces.actions.width + 2  # numbers in a row
        self.normaliser = RunningNormaliser(self.inputs)

    def read(self, episode: Episode, bonus: np.ndarray) -> np.ndarray:
        """The sequence of an episode with its bonus, [T]: float32 [at most `chunks`, inputs].

        The episode is cut into equal stretches. Each row has their mean observation, action
        (one-hot if Discrete), reward and bonus, standardised by all rows so far.
        """
        if not self.config.reads:
            return np.zeros((1, self.inputs), np.float32)
        actions = episode.actions
        if self.actions:
            actions = np.eye(self.actions, dtype=np.float32)[actions]
        seen = episode.observations.shape[1]
        rows = stretches(episode.observations, actions, episode.rewards, bonus, self.config.chunks)
        self.normaliser.update(rows)
        sequence = standardised(rows, self.normaliser.mean, self.normaliser.std, CLIP)
        sequence[:, :seen] /= np.float32(math.sqrt(seen))  # so that many weigh no more than few
        return sequence


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
