"""How runs are measured, and how Figure 1 is laid out."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, Field, NonNegativeInt, PositiveInt, model_validator

from mace_rl.config.section import ConfigError, Reference, Section

# What a metric may need of every environment of a study: a goal, as a return.
GOALS = ("reference_return", "solved_return")


def once(values: list[Any]) -> list[Any]:
    """The same; `ValueError` if one is there twice, which would count twice."""
    repeated = [value for value, count in Counter(values).items() if count > 1]
    if repeated:
        raise ValueError(f"{repeated[0]!r} should be there once")
    return values


Names = Annotated[list[str], Field(min_length=1), AfterValidator(once)]


class ConstantsConfig(Section):
    """Which variants are drawn as return over constant β."""

    learned: str  # the line across
    fixed: Names  # those whose β stays as it is, in their order


class MetricsConfig(Section):
    """How runs are measured and summarised."""

    final_fraction: float = Field(gt=0, le=1)  # the last part of training, for the final return
    threshold: float = Field(gt=0, lt=1)  # of the final return, for sample efficiency
    moving_average: PositiveInt  # W, episodes
    convergence_slope: float = Field(ge=0, lt=1)  # of the steepest so far: diminishing returns
    confidence: float = Field(gt=0, lt=1)  # of every interval
    bootstrap_repetitions: int = Field(ge=100, le=10**6)
    bootstrap_seed: NonNegativeInt
    random_return: dict[str, float]  # mean return of uniformly random actions, per environment
    reference_return: dict[str, float] = Field(default={})  # sets one bar for all variants
    solved_return: dict[str, float] = Field(default={})  # from which on an episode is solved
    # Which variant is compared with which, [variant, baseline], where the study has both.
    comparisons: list[Annotated[list[str], Field(min_length=2, max_length=2)]]
    learned: str = "mace_full"  # the variant that is the learned β of the claims
    constants: ConstantsConfig | None = None  # None: there is no picture of them
    custom: list[Reference] = Field(default=[])  # each a mace_study.measure.metrics.Metric

    @model_validator(mode="after")
    def _compared_once(self) -> "MetricsConfig":
        for place, pair in enumerate(self.comparisons):
            if pair[0] == pair[1] or pair in self.comparisons[:place]:
                raise ValueError(f"comparisons has {pair}: two different variants, each pair once")
        if self.constants and self.constants.learned in self.constants.fixed:
            raise ValueError(f"constants.fixed has the learned one, {self.constants.learned!r}")
        return self

    def random_return_in(self, environment: str) -> float:
        """The configured mean return of random actions; a `ConfigError` where there is none."""
        if environment not in self.random_return:
            raise ConfigError(
                f"the key 'metrics.random_return.{environment}' is missing: the mean return of"
                f" uniformly random actions in {environment}, which tools.random_return measures"
            )
        return self.random_return[environment]

    @property
    def goals(self) -> tuple[dict[str, float], ...]:
        """The values of `GOALS`, by environment; empty for a study without them."""
        return tuple(getattr(self, key) for key in GOALS)

    def incomplete(self, environments: Mapping[str, Sequence[str]]) -> list[str]:
        """A line for whatever `within` leaves out for want of some environments or variants."""
        lines = []
        for key, goal in zip(GOALS, self.goals, strict=True):
            missing = [name for name in environments if name not in goal]
            if missing and len(missing) < len(environments):
                lines.append(f"metrics.{key} is left out: it has nothing for {', '.join(missing)}")
        missing = [
            name
            for name in self.constant_variants()
            if not all(name in variants for variants in environments.values())
        ]
        if missing:
            lines.append(f"metrics.constants is left out: variants lacks {', '.join(missing)}")
        return lines

    def within(self, environments: Mapping[str, Sequence[str]]) -> "MetricsConfig":
        """These settings for a study of these; what `incomplete` names is left out.

        environments: each with its variants. Raises `ConfigError` for a goal that random actions
        attain.
        """
        left: dict[str, Any] = {}
        for key, goal in zip(GOALS, self.goals, strict=True):
            left[key] = {name: value for name, value in goal.items() if name in environments}
            for name, value in left[key].items():
                if value <= self.random_return_in(name):
                    raise ConfigError(
                        f"metrics.{key}.{name} is {value!r}, but should be greater than"
                        f" metrics.random_return.{name}, {self.random_return[name]!r}"
                    )
            left[key] = left[key] if len(left[key]) == len(environments) else {}
        if not all(set(own).issuperset(self.constant_variants()) for own in environments.values()):
            left["constants"] = None
        return self.model_copy(update=left)

    def constant_variants(self) -> list[str]:
        """Those that the picture of `constants` shows."""
        return [self.constants.learned, *self.constants.fixed] if self.constants else []

    def references(self) -> dict[str, str]:
        """By key, the code from outside this package that takes part, as package.module:Name."""
        return {f"metrics.custom.{place}": name for place, name in enumerate(self.custom)}


class FigureConfig(Section):
    """How the figures are laid out."""

    columns: int = Field(ge=1, le=100)  # panels side by side, one panel per environment
    # This share of the episodes once more, large, where most is learned in them; None: nowhere.
    inset: float | None = Field(default=None, gt=0, lt=1)
