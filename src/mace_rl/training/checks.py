"""What stands around the method: where an error was, and numbers of parts that may be anybody's."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

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


@contextmanager
def located(config: RunConfig, place: str) -> Iterator[None]:
    """A context in which an error says in which run it was, and at which `place` of it."""
    run = f"{config.environment} {config.variant} seed {config.seed}"
    try:
        yield
    except Refusal as error:
        raise type(error)(f"{run}, {place}: {error}") from error.__cause__
    except (SystemExit, GeneratorExit) as error:
        raise Refusal(f"{run}, {place}: code raised {error!r}") from error
    except Exception as error:
        error.add_note(f"in {run}, {place}")
        raise


def checked_beta(controller: BetaController) -> float:
    """What it sets for the next episode, in [0, 10]; `NonFiniteError` if it is not."""
    beta = float(numbers("β", controller.next_beta(), ()))
    require_within("β", beta, largest=LARGEST_BETA)
    return beta


def checked_bonus(intrinsic: IntrinsicReward, episode: Episode) -> Bonus:
    """That of an episode, from 0 on and not above `largest`; `NonFiniteError` if it is not."""
    bonus = intrinsic.bonus(episode)
    if not isinstance(bonus, Bonus):
        wanted = f"but should be a {Bonus.__module__}.Bonus"
        raise ConfigError(f"{type(intrinsic).__name__}.bonus is {short_repr(bonus)}, {wanted}")
    reward = numbers("the curiosity bonus", bonus.reward, (len(episode),))
    require_within("the curiosity bonus", reward, 1e-6, min(intrinsic.largest, TOO_LARGE))
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
