"""Settings of `mace_rl.published`: where the public code departs from the paper's text."""

from typing import Any

from mace_rl.config.agent import TorchModule
from mace_rl.config.section import Section


class PublishedConfig(Section):
    """As the public code has it; the other value is what the text says, or leads one to expect."""

    beta_reaches_reward: bool = False  # the network's β weighs the bonus of the next episode
    meta_sees_bonus: bool = False  # the network's input has the bonus, not 0 in its place
    bonus_times_reward: bool = True  # the bonus is multiplied by |r|, by 0.1 where r is 0
    bonus_at_most_one: bool = True  # novelty × relevance is cut off at 1
    counts_by_action_space: bool = True  # Discrete actions mean counts; false: observations do
    novelty_buffer_fills: bool = False  # while it is empty, novelty by distance is 1
    near_memory_pays: bool = True  # relevance is 1 / distance; false: distance / (1 + distance)
    memory_stores_twice: bool = True  # every state takes two places
    dropout: bool = True  # in the networks, while acting and while learning


# What else a run with this trainer is set to, since it computes nothing else.
COMPUTED: dict[str, Any] = dict.fromkeys(["bonus", "memory", "novelty", "meta"]) | {
    "engine": "torch",
    "ppo.network": TorchModule(kind="torch", module="mace_rl.published:Actor"),
    "ppo.hidden_units": [512, 256, 128, 64],
    "ppo.gae_lambda": 1.0,
    "ppo.rollout_steps": 1,
    "ppo.minibatch_size": None,
    "ppo.max_gradient_norm": None,
    "ppo.normalise_observations": False,
    "ppo.bootstrap_at_time_limit": False,
    "ppo.scale_rewards": False,
    "ppo.scale_advantages": False,
    "ppo.centre_advantages": False,
    "ppo.learn_log_std": False,
}
