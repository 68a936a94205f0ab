"""What stands around the method: where an error was, and numbers of parts that may be anybody's."""

import logging
from typing import Any

import numpy as np

from mace_rl.agent.learner import Learner, Update
from mace_rl.base.errors import Refusal
from mace_rl.beta.controller import BetaController
from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.config.beta import LARGEST_BETA
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError, short_repr
from mace_rl.environments.episode import Episode
from mace_rl.numerics.finite import TOO_LARGE, numbers, require_finite, require_within
from mace_rl.numerics.normaliser import RunningNormaliser

logger = logging.getLogger(__name__)


class Located:
    """A context in which an error says in which run it was, and at which `place` of it."""

    def __init__(self, config: RunConfig, place: str) -> None:
        self.config, self.place = config, place

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if not isinstance(error, Exception | SystemExit | GeneratorExit):
            return
        run = f"{self.config.environment} {self.config.variant} seed {self.config.seed}"
        if isinstance(error, Refusal):
            raise type(error)(f"{run}, {self.place}: {error}") from error.__cause__
        if not isinstance(error, Exception):
            raise Refusal(f"{run}, {self.place}: code raised {error!r}") from error
        error.add_note(f"in {run}, {self.place}")


class Checked:
    """A proxy of `part`; subclasses check what it returns."""

    def __init__(self, part: Any) -> None:
        object.__setattr__(self, "part", part)

    def __getattr__(self, name: str) -> Any:
        if name == "part":  # of a copy that is being made
            raise AttributeError(name)
        return getattr(self.part, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.part, name, value)


class CheckedBeta(Checked):
    """A `BetaController` whose β is a float in [0, 10]; `NonFiniteError` if it is not."""

    part: BetaController

    def next_beta(self) -> float:
        beta = float(numbers("β", self.part.next_beta(), ()))
        require_within("β", beta, largest=LARGEST_BETA)
        return beta


class CheckedBonus(Checked):
    """An `IntrinsicReward` of finite numbers from 0 on; `NonFiniteError` if they are not."""

    part: IntrinsicReward

    def bonus(self, episode: Episode) -> Bonus:
        bonus = self.part.bonus(episode)
        if not isinstance(bonus, Bonus):
            wanted = f"but should be a {Bonus.__module__}.Bonus"
            raise ConfigError(f"{type(self.part).__name__}.bonus is {short_repr(bonus)}, {wanted}")
        reward = numbers("the curiosity bonus", bonus.reward, (len(episode),))
        largest = min(self.part.largest, TOO_LARGE)
        require_within("the curiosity bonus", reward, 1e-6, largest)
        return bonus._replace(reward=np.maximum(reward, 0.0))


def require_learned(update: Update, learner: Learner) -> None:
    """`NonFiniteError` if an update went wrong; its gradients alone may be hidden by a tanh."""
    for name, norm in update.gradient_norms.items():
        require_finite(f"the {name}'s gradient norm", norm)
    for name, parameters in learner.parameters.items():
        require_finite(f"a weight of the {name}", parameters)


def warn_of_rewards(config: RunConfig, before: float, after: float, episode: int) -> None:
    """If the unit of rewards grew so much in an episode, not the first, that others are lost."""
    if episode > 1 and after > 1e6 * before:
        logger.warning(
            "%s: the rewards of episode %d are so large that others now count for a millionth",
            *(config.environment, episode),
        )


def warn_of_observations(config: RunConfig, normaliser: RunningNormaliser) -> None:
    """If there are dimensions whose differences are lost: tiny, or a few units of float32.

    A dimension that varies only by float64's rounding is constant: suspect if it is large.
    """
    if dimensions := unseen(normaliser):
        logger.warning(
            "%s: differences in observation%s are below 1e-8, or below what float32 tells apart, "
            "and are not learned from: use a smaller unit, or leave an offset out",
            *(config.environment, dimensions),
        )


def unseen(normaliser: RunningNormaliser) -> list[int]:
    """Those dimensions."""
    size = abs(normaliser.mean)
    deviation = np.sqrt(normaliser.sum_of_squares / normaliser.count)
    varies = deviation > 1e-12 * size
    few_units = deviation < size * 2.0**-22
    tiny = varies & ~few_units & (deviation <= 1e-8)
    offset = few_units & (size > np.where(varies, 1e3, 2.0**24))
    return np.flatnonzero(tiny | offset).tolist()
