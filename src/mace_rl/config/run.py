"""Everything that determines one training run, typed, frozen and checked once.

The values and their sources (paper, the authors' public code, our choice) stand in `config.yaml`;
this module says what each one means and which values are possible. A `RunConfig` is all a run
depends on besides the code: equal `RunConfig`s give equal results.
"""

from typing import Any, Literal

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
BONUS_SECTIONS = ("memory", "novelty")  # what only variants with a curiosity bonus use


class CompiledNetwork(Section):
    """A tanh network of `hidden_units`, compiled."""

    kind: Literal["mlp"]


class TorchModule(Section):
    """Any torch module: what `module` returns for (inputs, outputs, hidden_units, **arguments)."""

    kind: Literal["torch"]
    module: Reference
    arguments: dict[str, Any] = Field(default={})


NetworkConfig = CompiledNetwork | TorchModule


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
    initial_log_std: float = Field(ge=-10, le=2)  # Gaussian policies (Box actions) only
    max_gradient_norm: PositiveFloat
    normalise_observations: bool


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
    buffer_size: PositiveInt  # visited states that k-NN and density refer to, the last ones ...
    write_every: PositiveInt  # ... of every so many
    neighbours: list[PositiveInt] = Field(min_length=1)  # one k-NN estimator for each k
    knn_weight: float = Field(ge=0, le=1)  # the density estimator weighs 1 - knn_weight
    density_hidden_units: PositiveInt
    density_learning_rate: PositiveFloat = Field(lt=1)
    density_batch_size: PositiveInt
    density_steps: PositiveInt  # gradient steps of the density estimator after each episode

    @model_validator(mode="after")
    def _estimator_if_custom(self) -> "NoveltyConfig":
        if (self.kind == "custom") != (self.estimator is not None):
            raise ValueError("estimator and kind: custom go together")
        if self.arguments and self.kind != "custom":
            raise ValueError("arguments are those of an estimator, with kind: custom")
        return self


class MetaConfig(Section):
    """Meta-adaptation network: the LSTM that sets β (paper, supplement)."""

    hidden_units: PositiveInt
    learning_rate: PositiveFloat = Field(lt=1)
    max_gradient_norm: PositiveFloat
    max_sequence: PositiveInt | None  # longer episodes are condensed to this many elements


class NoBonus(Section):
    """Plain PPO: no curiosity, no memory, β = 0."""

    kind: Literal["none"]


class ExponentialBeta(Section):
    """β_n = max(floor, initial · decay^(n-1)) for episode n = 1, 2, …"""

    kind: Literal["exponential"]
    initial: float = Field(ge=0, le=1)
    decay: PositiveFloat = Field(le=1)
    floor: float = Field(ge=0, le=1)


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


BetaConfig = NoBonus | ExponentialBeta | MetaBeta | CustomBeta


class RunConfig(Section):
    """One training run: environment, variant, seed and every hyperparameter that it uses.

    `memory`, `novelty` and `meta` are there in variants that use them and None in the others, so
    that a change of what a variant does not use leaves its runs alone.
    """

    environment: str
    variant: str
    seed: int = Field(ge=0, lt=2**32)
    episodes: PositiveInt
    max_episode_steps: PositiveInt | None = None  # None: the environment's own time limit
    environment_arguments: dict[str, Any] = Field(default={})  # for the environment's constructor
    engine: Literal["compiled", "torch"] = "compiled"  # of every network
    ppo: PPOConfig
    memory: MemoryConfig | None = None
    novelty: NoveltyConfig | None = None
    meta: MetaConfig | None = None
    beta: BetaConfig = Field(discriminator="kind")

    @model_validator(mode="before")
    @classmethod
    def _only_what_is_used(cls, values: Any) -> Any:
        beta = values.get("beta") if isinstance(values, dict) else None
        kind = beta.get("kind") if isinstance(beta, dict) else getattr(beta, "kind", None)
        unused = unused_sections(kind)
        return {k: v for k, v in values.items() if k not in unused} if unused else values

    @model_validator(mode="after")
    def _all_that_is_used(self) -> "RunConfig":
        for section in {*BONUS_SECTIONS, "meta"} - set(unused_sections(self.beta.kind)):
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
            "novelty.estimator": self.novelty.estimator if self.novelty else None,
            "beta.rule": getattr(self.beta, "rule", None),
        }
        return {key: reference for key, reference in found.items() if reference is not None}


def unused_sections(beta: Any) -> tuple[str, ...]:
    """The sections that a variant does not use whose β is of this kind; none for unknown kinds."""
    match beta:
        case "none":
            return (*BONUS_SECTIONS, "meta")
        case "exponential" | "custom":
            return ("meta",)
        case _:
            return ()
