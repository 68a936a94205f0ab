"""How runs are measured, and how Figure 1 is laid out."""

from typing import Annotated

from pydantic import Field, NonNegativeInt, PositiveInt

from mace_rl.config.section import ConfigError, Reference, Section


class MetricsConfig(Section):
    """How runs are measured and summarised."""

    final_fraction: float = Field(gt=0, le=1)  # the last part of training, for the final return
    threshold: float = Field(gt=0, lt=1)  # of the final return, for sample efficiency
    moving_average: PositiveInt  # W, episodes
    convergence_band: float = Field(gt=0, lt=1)  # of the learning range, around the final return
    confidence: float = Field(gt=0, lt=1)  # of every interval
    bootstrap_repetitions: int = Field(ge=100)
    bootstrap_seed: NonNegativeInt
    random_return: dict[str, float]  # mean return of uniformly random actions, per environment
    # Which variant is compared with which, [variant, baseline], where the study has both.
    comparisons: list[Annotated[list[str], Field(min_length=2, max_length=2)]]
    custom: list[Reference] = Field(default=[])  # further ones: mace_rl.results.metrics.Metric

    def random_return_in(self, environment: str) -> float:
        """The configured mean return of random actions; a `ConfigError` where there is none."""
        if environment not in self.random_return:
            raise ConfigError(
                f"the key 'metrics.random_return.{environment}' is missing: the mean return of"
                f" uniformly random actions in {environment}"
            )
        return self.random_return[environment]

    def references(self) -> dict[str, str]:
        """By key, the code from outside this package that takes part, as package.module:Name."""
        return {f"metrics.custom.{place}": name for place, name in enumerate(self.custom)}


class FigureConfig(Section):
    """How the figures are laid out."""

    columns: PositiveInt  # panels side by side, one panel per environment
