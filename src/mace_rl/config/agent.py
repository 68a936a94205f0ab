"""Settings of `mace_rl.agent`: networks, critics and PPO."""

from typing import Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from mace_rl.config.section import Arguments, Count, Reference, Section, Units


class CompiledNetwork(Section):
    """A tanh network of `hidden_units`, compiled."""

    kind: Literal["mlp"]


class TorchModule(Section):
    """Any torch module, made as module(inputs, outputs, hidden_units, **arguments)."""

    kind: Literal["torch"]
    module: Reference
    arguments: Arguments = Field(default={})


NetworkConfig = CompiledNetwork | TorchModule


class PPOConfig(Section):
    """Proximal Policy Optimization (paper, Table 2; Schulman et al. 2017)."""

    actor_learning_rate: PositiveFloat = Field(lt=1)
    critic_learning_rate: PositiveFloat = Field(lt=1)
    discount: float = Field(ge=0, le=1)  # γ
    epochs: Count  # K, passes over the rollout at each update
    clip: PositiveFloat = Field(lt=1)  # ε
    gae_lambda: float = Field(ge=0, le=1)  # λ; 1 is the Monte Carlo return minus the baseline
    entropy_coefficient: NonNegativeFloat
    # An update follows the first episode end after this many steps, so 1 is one update per episode:
    # rollouts are whole episodes, since β belongs to an episode.
    rollout_steps: Count
    minibatch_size: Count | None  # None: the whole rollout is one batch
    network: NetworkConfig = Field(default=CompiledNetwork(kind="mlp"), discriminator="kind")
    hidden_units: list[Units] = Field(min_length=1)
    initial_log_std: float = Field(ge=-10, le=2)  # Gaussian policies (Box actions) only
    learn_log_std: bool = True  # False: it stays as it began
    clip_actions: bool = True  # to their bounds, before the environment gets them
    max_gradient_norm: PositiveFloat | None  # None: gradients are not clipped
    normalise_observations: bool
    # Rewards are divided by the running standard deviation of their discounted sums; extrinsic ones
    # by at least 1, which does not amplify tiny costs.
    scale_rewards: bool
    # Extrinsic and intrinsic advantages are each divided by their running root mean square, the
    # extrinsic by at least `smallest_advantage`, so that β is a relative strength.
    scale_advantages: bool
    smallest_advantage: PositiveFloat
    centre_advantages: bool  # subtract the rollout's mean from total advantages
    bootstrap_at_time_limit: bool = True  # False: a state it cut off at is worth 0, like a last one
    normalise_returns: bool = False  # in each episode, by their mean and the total ones' deviation

    @model_validator(mode="after")
    def _units_agree(self) -> "PPOConfig":
        # A critic of normalised returns knows none as it was paid, so it may be part of none.
        # And scales are measured on advantages as they were before.
        own = self.gae_lambda < 1 or self.bootstrap_at_time_limit or self.scale_advantages
        if self.normalise_returns and own:
            right = "gae_lambda: 1.0, bootstrap_at_time_limit: false and scale_advantages: false"
            raise ValueError(f"normalise_returns goes with {right}")
        return self
