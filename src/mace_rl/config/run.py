"""Everything that determines one training run, typed, frozen and checked once.

The values and their sources (paper, the authors' public code, our choice) stand in `config.yaml`;
this module says what each one means and which values are possible. A `RunConfig` is all a run
depends on besides the code: equal `RunConfig`s give equal results.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from mace_rl.config.section import Reference, Section

# What identifies a run; every other key of RunConfig is a setting.
IDENTITY = ("environment", "variant", "seed")
BONUS_SECTIONS = ("bonus", "memory", "novelty")  # what only variants with a bonus use


class CompiledNetwork(Section):
    """A tanh network of `hidden_units`, compiled."""

    kind: Literal["mlp"]


class TorchModule(Section):
    """Any torch module: what `module` returns for (inputs, outputs, hidden_units, **arguments)."""

    kind: Literal["torch"]
    module: Reference
    arguments: dict[str, Any] = Field(default={})


NetworkConfig = CompiledNetwork | TorchModule


class NetworkValue(Section):
    """A critic that is a network, as the policy is."""

    kind: Literal["network"]

    def __str__(self) -> str:
        return "network"


class DictionaryValue(Section):
    """A critic that is a dictionary of states and returns (Pritzel et al. 2017)."""

    kind: Literal["dictionary"]
    capacity: PositiveInt  # states
    neighbours: PositiveInt  # k, whose returns make a value
    kernel_bandwidth: PositiveFloat  # δ of the kernel 1 / (d² + δ), in standardised units
    learning_rate: PositiveFloat = Field(le=1)  # α, at which a remembered state's return moves

    def __str__(self) -> str:
        return f"dictionary of {self.capacity} states"

    @model_validator(mode="after")
    def _neighbours_fit(self) -> "DictionaryValue":
        if self.neighbours > self.capacity:
            raise ValueError(
                f"neighbours is {self.neighbours}, which must not exceed capacity, {self.capacity}"
            )
        return self


CriticConfig = NetworkValue | DictionaryValue


class PPOConfig(Section):
    """Proximal Policy Optimization (paper, Table 2; Schulman et al. 2017)."""

    actor_learning_rate: PositiveFloat = Field(lt=1)
    critic_learning_rate: PositiveFloat = Field(lt=1)
    discount: float = Field(ge=0, le=1)  # γ
    epochs: PositiveInt  # K, passes over the rollout at each update
    clip: PositiveFloat = Field(lt=1)  # ε
    gae_lambda: float = Field(ge=0, le=1)  # λ; 1 is the Monte Carlo return minus the baseline
    entropy_coefficient: NonNegativeFloat
    # An update follows the first episode end at which this many steps have been collected, so 1
    # is one update per episode. Rollouts are whole episodes: β belongs to an episode.
    rollout_steps: PositiveInt
    minibatch_size: PositiveInt | None  # None: the whole rollout is one batch
    network: NetworkConfig = Field(default=CompiledNetwork(kind="mlp"), discriminator="kind")
    hidden_units: list[PositiveInt] = Field(min_length=1)
    critic: CriticConfig = Field(default=NetworkValue(kind="network"), discriminator="kind")
    initial_log_std: float = Field(ge=-10, le=2)  # Gaussian policies (Box actions) only
    max_gradient_norm: PositiveFloat
    normalise_observations: bool
    # Rewards are divided by the running standard deviation of their discounted sums; extrinsic ones
    # by at least 1, lest tiny costs be blown up.
    scale_rewards: bool
    # Extrinsic and intrinsic advantages are each divided by their running root mean square before β
    # weighs them, extrinsic ones by at least `smallest_advantage`: β is then a relative strength.
    scale_advantages: bool
    smallest_advantage: PositiveFloat
    centre_advantages: bool  # subtract the rollout's mean from total advantages


class MemoryConfig(Section):
    """Episodic memory: a differentiable neural dictionary (paper, supplement)."""

    capacity: PositiveInt  # entries
    neighbours: PositiveInt  # k of the top-k lookup
    kernel_bandwidth: PositiveFloat  # δ of the kernel 1 / (d² + δ), in standardised units
    write_every: PositiveInt  # one step in this many is written

    @model_validator(mode="after")
    def _neighbours_fit(self) -> "MemoryConfig":
        if self.neighbours > self.capacity:
            raise ValueError(
                f"neighbours is {self.neighbours}, which must not exceed capacity, {self.capacity}"
            )
        return self


class NoveltyConfig(Section):
    """Novelty: visitation counts (Discrete observations) or k-NN and density (Box)."""

    # auto: by the observation space; custom: the class `estimator` gets (size, generator,
    # **arguments), with what mace_rl.bonus.novelty.Novelty asks for.
    kind: Literal["auto", "counts", "density", "custom"] = "auto"
    estimator: Reference | None = None
    arguments: dict[str, Any] = Field(default={})
    count_decay: PositiveFloat = Field(le=1)  # factor on all counts after each episode
    buffer_size: PositiveInt  # visited states that k-NN and density refer to, a cover of ...
    write_every: PositiveInt  # ... one in so many
    neighbours: list[PositiveInt] = Field(min_length=1)  # one k-NN estimator for each k
    calibration_states: PositiveInt  # a sample of them says what distance is usual
    knn_weight: float = Field(ge=0, le=1)  # the density estimator weighs 1 - knn_weight
    density_hidden_units: PositiveInt
    density_learning_rate: PositiveFloat = Field(lt=1)
    density_batch_size: PositiveInt
    density_steps: PositiveInt  # gradient steps of the density estimator after each episode

    @model_validator(mode="after")
    def _neighbours_fit(self) -> "NoveltyConfig":
        if max(self.neighbours) >= self.buffer_size:
            raise ValueError(
                f"neighbours has {max(self.neighbours)}, which must be less than buffer_size,"
                f" {self.buffer_size}"
            )
        return self

    @model_validator(mode="after")
    def _estimator_if_custom(self) -> "NoveltyConfig":
        if (self.kind == "custom") != (self.estimator is not None):
            raise ValueError("estimator and kind: custom go together")
        if self.arguments and self.kind != "custom":
            raise ValueError("arguments are those of an estimator, with kind: custom")
        return self


class CuriosityBonus(Section):
    """Curiosity: novelty × memory relevance (paper); without `relevance`, novelty alone."""

    kind: Literal["curiosity"]
    relevance: bool = True


class ICMBonus(Section):
    """Intrinsic curiosity module (Pathak et al. 2017): `mace_rl.bonus.icm`."""

    kind: Literal["icm"]
    feature_units: PositiveInt = 32  # numbers in φ(s); the paper has 288 for images
    hidden_units: PositiveInt = 64  # of the one hidden layer in each of its three networks
    learning_rate: PositiveFloat = Field(default=0.001, lt=1)  # the paper's
    batch_size: PositiveInt = 64  # steps; each episode is learnt from once
    forward_weight: float = Field(default=0.2, ge=0, le=1)  # β of its equation 7, the paper's
    scale: PositiveFloat = 1.0  # η


class RNDBonus(Section):
    """Random network distillation (Burda et al. 2018): `mace_rl.bonus.rnd`."""

    kind: Literal["rnd"]
    feature_units: PositiveInt = 64  # outputs of both networks; the paper has 512 for images
    hidden_units: PositiveInt = 64  # of the one hidden layer in each
    learning_rate: PositiveFloat = Field(default=0.001, lt=1)  # the paper has 0.0001, for images
    batch_size: PositiveInt = 64  # steps; each episode is learnt from once


class HashCountsBonus(Section):
    """Counts of hashed states (Tang et al. 2017): `mace_rl.bonus.hashing`."""

    kind: Literal["hash_counts"]
    bits: int = Field(default=16, ge=1, le=62)  # k; more tell more states apart
    calibration_states: PositiveInt = 1000  # the first visited; states are hashed in their units


class CustomBonus(Section):
    """A bonus from the class `estimator`, a `mace_rl.bonus.intrinsic.IntrinsicReward`.

    It is made as estimator(size, action_space, generator, **arguments).
    """

    kind: Literal["custom"]
    estimator: Reference
    arguments: dict[str, Any] = Field(default={})


BonusConfig = CuriosityBonus | ICMBonus | RNDBonus | HashCountsBonus | CustomBonus


class MetaConfig(Section):
    """Meta-adaptation network: the LSTM that sets β (paper, supplement)."""

    hidden_units: PositiveInt
    learning_rate: NonNegativeFloat = Field(lt=1)  # 0: the LSTM stays as it was initialised
    max_gradient_norm: PositiveFloat
    horizon: PositiveInt  # updates after an episode that judge its β
    prior: NonNegativeFloat  # pull of β's logit back to the initial β's, per unit of distance
    max_credit: PositiveFloat  # bound of a β's credit, in units of its usual size
    max_sequence: PositiveInt | None  # longer episodes are condensed to this many elements


class NoBonus(Section):
    """Plain PPO: no curiosity, no memory, β = 0."""

    kind: Literal["none"]


class ConstantBeta(Section):
    """The same β in every episode."""

    kind: Literal["constant"]
    value: float = Field(ge=0, le=1)


class RandomBeta(Section):
    """β uniform between `low` and `high`, drawn for every episode."""

    kind: Literal["random"]
    low: float = Field(ge=0, le=1)
    high: float = Field(ge=0, le=1)

    @model_validator(mode="after")
    def _in_order(self) -> "RandomBeta":
        if self.low > self.high:
            raise ValueError(f"low is {self.low}, which must not exceed high, {self.high}")
        return self


class BanditBeta(Section):
    """β from a bandit that follows the returns (Badia et al. 2020, appendix D)."""

    kind: Literal["bandit"]
    arms: list[Annotated[float, Field(ge=0, le=1)]] = Field(min_length=1)  # the βs to choose from
    window: PositiveInt  # pulls that count, the last ones
    exploration: NonNegativeFloat  # of the bonus √(1 / pulls), in ranges of the return
    epsilon: float = Field(ge=0, le=1)  # probability of an arm at random

    @model_validator(mode="after")
    def _arms_fit(self) -> "BanditBeta":
        if len(set(self.arms)) < len(self.arms):
            raise ValueError(f"arms has a β twice: {self.arms}")
        if self.window < len(self.arms):
            raise ValueError(
                f"window is {self.window}, which must hold each of the {len(self.arms)} arms"
            )
        return self


class ExponentialBeta(Section):
    """β_n = max(floor, initial · decay^(n-1)) for episode n = 1, 2, …"""

    kind: Literal["exponential"]
    initial: float = Field(ge=0, le=1)
    decay: PositiveFloat = Field(le=1)
    floor: float = Field(ge=0, le=1)

    @model_validator(mode="after")
    def _falls(self) -> "ExponentialBeta":
        if self.floor > self.initial:
            raise ValueError(
                f"floor is {self.floor}, which must not exceed initial, {self.initial}"
            )
        return self


class MetaBeta(Section):
    """β from the meta-adaptation network; `initial` is β of the first episode."""

    kind: Literal["meta"]
    initial: float = Field(gt=0, lt=1)


class CustomBeta(Section):
    """β from the class `rule`, a `mace_rl.beta.controller.BetaController`.

    It is made as rule(generator, **arguments).
    """

    kind: Literal["custom"]
    rule: Reference
    arguments: dict[str, Any] = Field(default={})


BetaRule = ConstantBeta | RandomBeta | BanditBeta | ExponentialBeta | CustomBeta
BetaConfig = NoBonus | MetaBeta | BetaRule


class RunConfig(Section):
    """One training run: environment, variant, seed and every hyperparameter that it uses.

    `bonus`, `memory`, `novelty` and `meta` are there in variants that use them and None in the
    others, so that a change of what a variant does not use leaves its runs alone.
    """

    environment: str
    variant: str
    seed: int = Field(ge=0, lt=2**32)
    episodes: PositiveInt
    max_episode_steps: PositiveInt | None = None  # None: the environment's own time limit
    environment_arguments: dict[str, Any] = Field(default={})  # for the environment's constructor
    engine: Literal["compiled", "torch"] = "compiled"  # of every network
    ppo: PPOConfig
    bonus: BonusConfig | None = Field(default=None, discriminator="kind")
    memory: MemoryConfig | None = None
    novelty: NoveltyConfig | None = None
    meta: MetaConfig | None = None
    beta: BetaConfig = Field(discriminator="kind")

    @model_validator(mode="before")
    @classmethod
    def _only_what_is_used(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        unused = unused_sections(values)
        values = {"bonus": {"kind": "curiosity"}} | values
        return {key: value for key, value in values.items() if key not in unused}

    @model_validator(mode="after")
    def _all_that_is_used(self) -> "RunConfig":
        for section in {*BONUS_SECTIONS, "meta"} - set(unused_sections(self)):
            if getattr(self, section) is None:
                raise ValueError(f"the section {section!r} is missing")
        return self

    def settings(self) -> dict[str, Any]:
        """Plain values, as in `run.json`, without what is not used: equal ones, equal results."""
        return {name: value for name, value in self.model_dump().items() if value is not None}

    def references(self) -> dict[str, str]:
        """By key, the code from outside this package that takes part, as package.module:Name."""
        found = {
            "environment": self.environment if ":" in self.environment else None,
            "ppo.network.module": getattr(self.ppo.network, "module", None),
            "bonus.estimator": getattr(self.bonus, "estimator", None),
            "novelty.estimator": self.novelty.estimator if self.novelty else None,
            "beta.rule": getattr(self.beta, "rule", None),
        }
        return {key: reference for key, reference in found.items() if reference is not None}


def unused_sections(settings: Any) -> dict[str, str]:
    """The sections that a run with these settings does not use, each with what in them says so.

    settings: a `RunConfig`, or plain values before they are checked.
    """

    def value(*keys: str) -> Any:
        found = settings
        for key in keys:
            of_mapping = isinstance(found, Mapping)
            found = found.get(key) if of_mapping else getattr(found, key, None)
        return found

    beta, bonus = value("beta", "kind"), value("bonus", "kind")
    if beta == "none":
        return dict.fromkeys((*BONUS_SECTIONS, "meta"), "beta.kind 'none'")
    unused = {}
    if beta in ("constant", "random", "bandit", "exponential", "custom"):
        unused["meta"] = f"beta.kind {beta!r}"
    if value("bonus", "relevance") is False:
        unused["memory"] = "bonus.relevance false"
    if bonus in ("icm", "rnd", "hash_counts", "custom"):
        unused |= dict.fromkeys(("memory", "novelty"), f"bonus.kind {bonus!r}")
    return unused
