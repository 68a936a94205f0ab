"""Everything that determines one training run, typed, frozen and checked once.

The values and their sources (paper, the authors' public code, our choice) stand in `config.yaml`;
this module says what each one means and which values are possible. A `RunConfig` is all a run
depends on besides the code: equal `RunConfig`s give equal results.
"""

import difflib
from typing import Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)

Model = TypeVar("Model", bound=BaseModel)


class ConfigError(ValueError):
    """A setting that cannot be used; the message names key, value and what would be right."""


class Section(BaseModel):
    """Base of every configuration section: unknown keys, wrong types, NaN and Inf are errors."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=()
    )


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

    count_decay: PositiveFloat = Field(le=1)  # factor on all counts after each episode
    buffer_size: PositiveInt  # visited states that k-NN and density refer to, the last ones ...
    write_every: PositiveInt  # ... of every so many
    neighbours: list[PositiveInt] = Field(min_length=1)  # one k-NN estimator for each k
    knn_weight: float = Field(ge=0, le=1)  # the density estimator weighs 1 - knn_weight
    density_hidden_units: PositiveInt
    density_learning_rate: PositiveFloat = Field(lt=1)
    density_batch_size: PositiveInt
    density_steps: PositiveInt  # gradient steps of the density estimator after each episode


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


class RunConfig(Section):
    """One training run: environment, variant, seed and every hyperparameter."""

    environment: str
    variant: str
    seed: int = Field(ge=0, lt=2**32)
    episodes: PositiveInt
    ppo: PPOConfig
    memory: MemoryConfig
    novelty: NoveltyConfig
    meta: MetaConfig
    beta: NoBonus | ExponentialBeta | MetaBeta = Field(discriminator="kind")


def check(model: type[Model], values: Any, origin: str) -> Model:
    """Build `model` from `values`, or raise a one-line `ConfigError` for the first mistake.

    `origin` says where the values come from (a file name) and starts the message.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{origin}: {explain(error, model)}") from None


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first problem of a pydantic `error` on one line: key, value, what would be right."""
    problem = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in problem["loc"]) or "the configuration"
    value = repr(problem["input"])
    value = value if len(value) <= 60 else value[:57] + "..."
    match problem["type"]:
        case "extra_forbidden":
            known = _keys_beside(model, problem["loc"])
            nearest = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1, cutoff=0)
            return f"unknown key {key!r} (value {value}); the nearest known key is {nearest[0]!r}"
        case "missing":
            return f"the key {key!r} is missing"
        case _:
            reason = problem["msg"].removeprefix("Value error, ").removeprefix("Input ")
            reason = reason.replace(" after validation, not 0", "")
            return f"{key} is {value}, but {reason}"


def _keys_beside(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """The known keys of the section that `location`'s last element was found in."""
    for part in location[:-1]:
        field = model.model_fields.get(str(part))
        if field is None:
            continue  # a union's tag or a list index
        annotation: Any = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            model = annotation
        elif part == "beta":
            tag = location[location.index(part) + 1]
            options = {"none": NoBonus, "exponential": ExponentialBeta, "meta": MetaBeta}
            model = options[str(tag)]
    return list(model.model_fields)
