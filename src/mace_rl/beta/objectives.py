"""What the meta-adaptation network learns from: readings of a sentence that the paper leaves open.

The paper (supplement): "The network is trained with its own optimizer, separate from the main PPO
agent, forming a meta-learning loop where the agent learns how to best guide its own exploration."
It names no loss. Each class here is a loss L by what episodes return, and says its slope dL/do. o
is the network's output, and β has the logit of the initial β plus o. Two more, by policy gradients,
are in `beta.credit`.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaGradient
from mace_rl.config.beta import (
    PerturbedObjective,
    ProgressObjective,
    ReturnObjective,
    ScoreObjective,
    WordsObjective,
)

LARGEST = 3.0  # bound of what a β is paid, in units of its usual size


class Played(NamedTuple):
    """An episode whose β the network has set."""

    sequence: np.ndarray  # what the network had read, float32 [steps, in]
    output: float  # o
    added: float  # to the initial logit: o, as a rule
    beta: float
    extrinsic_return: float


class Lesson(NamedTuple):
    """What the network is to learn: one step down L, averaged over the sequences."""

    sequences: list[np.ndarray]
    slope: float  # dL/do of each


class Objective(Stateful, ABC):
    """A loss of the meta-adaptation network."""

    asks_policy = False  # whether it learns from policy gradients, in `after_rollout`

    def logit(self, output: float) -> float:
        """What an output adds to the logit of the next episode's β."""
        return output

    @abstractmethod
    def after_episode(self, played: Played) -> Lesson | None:
        """Take in an episode; what the network is to learn before it sets the next β."""

    def after_rollout(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> tuple[float | None, Lesson | None]:
        """The credit of an earlier β and what follows from it; see `BetaController.learn`."""
        raise NotImplementedError("this objective asks for no policy gradients")


def evenly(items: list[Any], most: int) -> list[Any]:
    """All of them, or `most` at equal distances."""
    if len(items) <= most:
        return items
    return [items[place] for place in np.arange(most) * len(items) // most]


def mean(values: Any) -> float:
    """Σ x / N."""
    return sum(values) / len(values)


def deviation(values: Collection[float], centre: float) -> float:
    """The root mean square distance of values from `centre`; 0 of none."""
    return math.sqrt(mean([(value - centre) ** 2 for value in values])) if values else 0.0


def in_units(value: float, before: Collection[float], centred: bool) -> float:
    """`value` in units of the usual size of those before, within ±`LARGEST`; 0 while that is 0.

    centred: both are less the mean of those before.
    """
    if centred and len({*before}) == 1:  # of whose mean rounding may leave a difference
        return 0.0
    centre = mean(before) if centred and before else 0.0
    usual = deviation(before, centre)
    return min(max((value - centre) / usual, -LARGEST), LARGEST) if usual > 0 else 0.0


class Return(Objective):
    """L = −R β, with R the return of the episode that was played under β.

    The public code's loss is −R, as a new tensor from which no gradient reaches the network
    (docs/deviations.md): here it is connected through β. `centred`: less the mean of the last
    returns, which a policy gradient would call its baseline. Both in units of the last returns.
    """

    STATE = ("returns",)

    def __init__(self, config: ReturnObjective) -> None:
        self.centred = config.centred
        self.returns: deque[float] = deque(maxlen=config.recent)

    def after_episode(self, played: Played) -> Lesson | None:
        paid = in_units(played.extrinsic_return, self.returns, self.centred)
        self.returns.append(played.extrinsic_return)
        return Lesson([played.sequence], -paid * played.beta * (1 - played.beta))


class Perturbed(Objective):
    """L = −J, of what follows when the logit of β is perturbed (Spall 1992; Williams 1992).

    "the agent learns an optimal, non-stationary schedule for its curiosity bonus". o is perturbed
    by ξ, which is `noise` or −`noise` by chance for a window of episodes, then its opposite for the
    next. A β acts in the update after its episode, and what that changes lasts: the payment p of an
    episode is for e, the mean of all ξ before it, of which the n-th last weighs (1 − 1/lag)ⁿ, in
    units of `noise`. So −p e is dL/do on average, up to a factor.
    """

    STATE: tuple[str, ...] = ("generator", "perturbation", "episodes", "trace", "sequence")

    def __init__(self, config: PerturbedObjective, generator: np.random.Generator) -> None:
        self.config, self.generator = config, generator
        self.episodes, self.trace = 0, 0.0  # those played; e
        self.perturbation = self.either_sign()  # ξ
        self.sequence: np.ndarray | None = None  # read for the last episode's β

    def either_sign(self) -> float:
        """`noise` or its opposite."""
        return self.config.noise if self.generator.random() < 0.5 else -self.config.noise

    def logit(self, output: float) -> float:
        return output + self.perturbation

    def after_episode(self, played: Played) -> Lesson | None:
        before, slope = self.sequence, -self.paid(played.extrinsic_return) * self.trace
        self.sequence = played.sequence
        # Its own ξ: where several environments are played at once, the next may have another.
        perturbed = math.copysign(1.0, played.added - played.output)
        self.trace += (perturbed - self.trace) / self.config.lag
        self.count_episode()
        return None if before is None else Lesson([before], slope)

    def count_episode(self) -> None:
        """Set ξ for the next episode."""
        self.episodes += 1
        if self.episodes % (2 * self.config.window) == 0:
            self.perturbation = self.either_sign()
        elif self.episodes % self.config.window == 0:
            self.perturbation = -self.perturbation

    @abstractmethod
    def paid(self, extrinsic_return: float) -> float:
        """p of the next episode in order, in units of its usual size."""


class Score(Perturbed):
    """`Perturbed`, paid by returns: J is their mean, and the mean of the last ones its baseline."""

    STATE = (*Perturbed.STATE, "returns")

    def __init__(self, config: ScoreObjective, generator: np.random.Generator) -> None:
        super().__init__(config, generator)
        self.returns: deque[float] = deque(maxlen=config.recent)

    def paid(self, extrinsic_return: float) -> float:
        result = in_units(extrinsic_return, self.returns, centred=True)
        self.returns.append(extrinsic_return)
        return result


class Progress(Perturbed):
    """`Perturbed`, paid by learning progress (Schmidhuber 1991): J is how much returns rise.

    "monitors the agent's performance", "learning dynamics". Progress is the mean of the last
    `stretch` returns less that of as many before.
    """

    STATE = (*Perturbed.STATE, "returns", "rises")

    def __init__(self, config: ProgressObjective, generator: np.random.Generator) -> None:
        super().__init__(config, generator)
        self.stretch = config.stretch
        self.returns: deque[float] = deque(maxlen=2 * config.stretch)
        self.rises: deque[float] = deque(maxlen=config.recent)

    def paid(self, extrinsic_return: float) -> float:
        self.returns.append(extrinsic_return)
        if len(self.returns) < 2 * self.stretch:
            return 0.0
        rise = difference(self.returns)
        result = in_units(rise, self.rises, centred=False)
        self.rises.append(rise)
        return result


class Words(Objective):
    """L = −t log β − (1 − t) log (1 − β): β is trained to do what the paper says that it does.

    "increasing it when performance stagnates and decreasing it when it is successfully exploiting
    its knowledge": the target t is 0 where the mean of the last `stretch` returns is above that of
    as many before by more than the standard error of their difference, else 1.
    """

    STATE = ("returns",)

    def __init__(self, config: WordsObjective) -> None:
        self.stretch = config.stretch
        self.returns: deque[float] = deque(maxlen=2 * config.stretch)

    def after_episode(self, played: Played) -> Lesson | None:
        self.returns.append(played.extrinsic_return)
        if len(self.returns) < 2 * self.stretch:
            return None
        halves = [*self.returns][: self.stretch], [*self.returns][self.stretch :]
        squares = sum(deviation(half, mean(half)) ** 2 for half in halves)
        rises = difference(self.returns) > math.sqrt(squares / self.stretch)
        return Lesson([played.sequence], played.beta - (0.0 if rises else 1.0))


def difference(values: Any) -> float:
    """The mean of the second half less that of the first."""
    listed, half = [*values], len(values) // 2
    return mean(listed[half:]) - mean(listed[:half])
