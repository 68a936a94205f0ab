"""How runs are measured, and how Figure 1 is laid out."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field, NonNegativeInt, PositiveInt, model_validator

from mace_rl.config.section import ConfigError, Reference, Section

# What a metric may need of every environment of a study: a goal, as a return.
GOALS = ("reference_return", "solved_return")


class RegretConfig(Section):
    """Whose regret is measured, against the best of which constants."""

    variant: str
    constants: list[str] = Field(min_length=1)  # variants too, such as those with a fixed β


class MetricsConfig(Section):
    """How runs are measured and summarised."""

    final_fraction: float = Field(gt=0, le=1)  # the last part of training, for the final return
    threshold: float = Field(gt=0, lt=1)  # of the final return, for sample efficiency
    moving_average: PositiveInt  # W, episodes
    convergence_slope: float = Field(ge=0, lt=1)  # of the steepest so far: diminishing returns
    convergence_band: float = Field(gt=0, lt=1)  # of the learning range, around the final return
    confidence: float = Field(gt=0, lt=1)  # of every interval
    bootstrap_repetitions: int = Field(ge=100)
    bootstrap_seed: NonNegativeInt
    random_return: dict[str, float]  # mean return of uniformly random actions, per environment
    reference_return: dict[str, float] = Field(default={})  # sets one bar for all variants
    solved_return: dict[str, float] = Field(default={})  # from which on an episode is solved
    # Which variant is compared with which, [variant, baseline], where the study has both.
    comparisons: list[Annotated[list[str], Field(min_length=2, max_length=2)]]
    regret: RegretConfig | None = None  # None: there is no regret.csv
    custom: list[Reference] = Field(default=[])  # further ones: mace_rl.results.metrics.Metric

    @model_validator(mode="after")
    def _compared_once(self) -> "MetricsConfig":
        for place, pair in enumerate(self.comparisons):
            if pair[0] == pair[1] or pair in self.comparisons[:place]:
                raise ValueError(f"comparisons has {pair}: two different variants, each pair once")
        if self.regret and self.regret.variant in self.regret.constants:
            raise ValueError(f"regret.constants has the variant itself, {self.regret.variant!r}")
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

    def incomplete(self, environments: Sequence[str]) -> list[str]:
        """A line for each of `GOALS` that `within` leaves out for want of some environments."""
        lines = []
        for key in GOALS:
            goal = getattr(self, key)
            missing = [name for name in environments if name not in goal]
            if missing and len(missing) < len(environments):
                lines.append(f"metrics.{key} is left out: it has nothing for {', '.join(missing)}")
        return lines

    def within(self, environments: Sequence[str], variants: Sequence[str]) -> "MetricsConfig":
        """These settings for a study of these environments and variants.

        Of `GOALS`, what not every environment has is left out (see `incomplete`). Raises
        `ConfigError` for a goal that random actions attain, and for a regret of variants that the
        study does not have.
        """
        goals: dict[str, dict[str, float]] = {}
        for key in GOALS:
            given = {
                name: value for name, value in getattr(self, key).items() if name in environments
            }
            for name, value in given.items():
                if value <= self.random_return_in(name):
                    raise ConfigError(
                        f"metrics.{key}.{name} is {value!r}, but should be greater than"
                        f" metrics.random_return.{name}, {self.random_return[name]!r}"
                    )
            goals[key] = given if len(given) == len(environments) else {}
        for variant in [self.regret.variant, *self.regret.constants] if self.regret else []:
            if variant not in variants:
                raise ConfigError(f"metrics.regret has {variant!r}, which is not in variants")
        return self.model_copy(update=goals)

    def references(self) -> dict[str, str]:
        """By key, the code from outside this package that takes part, as package.module:Name."""
        return {f"metrics.custom.{place}": name for place, name in enumerate(self.custom)}


class FigureConfig(Section):
    """How the figures are laid out."""

    columns: PositiveInt  # panels side by side, one panel per environment
    # This share of the episodes once more, large, where most is learned in them; None: nowhere.
    inset: float | None = Field(default=None, gt=0, lt=1)
