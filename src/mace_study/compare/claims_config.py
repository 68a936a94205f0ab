"""What a paper says, and what we ask ourselves: the file that `claims` in config.yaml names."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from pydantic import AfterValidator, Field, model_validator

from mace_rl.config.agent import PPOConfig
from mace_rl.config.reading import Settings, read_yaml
from mace_rl.config.section import ConfigError, Section, check, check_known
from mace_study.compare.ledger import Answer
from mace_study.config.labels import require_latex
from mace_study.config.metrics import MetricsConfig, Names, once
from mace_study.measure.metrics import CORRELATIONS, METRICS, all_metrics

if TYPE_CHECKING:  # imports Gymnasium, which tables do without
    from mace_study.config.study import Study


class Part(NamedTuple):
    """In these environments, on this metric: `variant` is better than `baseline`."""

    environments: tuple[str, ...]  # of several the mean of the differences, as shares of each scale
    metric: str
    variant: str
    baseline: str | None  # None: over 0
    in_paper: float  # variant - baseline in the paper's Table 1; NaN where that has none


LEARNED = "mace_full"  # what the file calls the learned β
FEWEST_SEEDS = 10  # with fewer nothing is decided: that would be an anecdote


class Table1Config(Section):
    """The paper's Table 1."""

    caption: Annotated[str, Field(min_length=1)]  # the names of its metrics
    metrics: Names  # readings of one are the metrics whose names begin with its name
    public_code: list[str] = Field(default=[])  # a reading of each by its rule; or none
    variants: Annotated[dict[str, str], Field(min_length=1)]  # and what the ledger calls them
    # By environment and variant a number for each metric.
    values: dict[str, dict[str, list[int | float]]]

    def value(self, environment: str, variant: str, metric: str) -> float | None:
        """What the paper has there; None where it has nothing."""
        numbers = self.values.get(environment, {}).get(variant)
        return numbers[self.metrics.index(metric)] if numbers and metric in self.metrics else None

    def metric_of(self, reading: str) -> str | None:
        """The metric that this is a reading of: of those that its name begins with the longest."""
        kinds = [metric for metric in self.metrics if reading.startswith(metric)]
        return max(kinds, key=len, default=None)

    def values_of(self, environments: Sequence[str], reading: str) -> dict[str, float]:
        """By variant what the paper has of this reading's metric; nothing of several together."""
        kind = self.metric_of(reading)
        rows = self.values.get(environments[0], {}) if len(environments) == 1 else {}
        if kind is None or not rows:
            return {}
        return {name: rows[name][self.metrics.index(kind)] for name in self.variants}

    def is_within(self, environments: Mapping[str, Sequence[str]]) -> bool:
        """Whether a study of these, each with its variants, has all that the table has."""
        return all(set(self.variants) <= {*environments.get(env, ())} for env in self.values)


class Table2Config(Section):
    """The paper's Table 2: labels by the setting of `ppo`."""

    rows: dict[str, str] = Field(default={})  # what the paper has
    others: dict[str, str] = Field(default={})  # what the paper leaves open


class PartsConfig(Section):
    """Parts of a claim that differ in environment and in what `variant` is better than."""

    environments: Names  # a part for each ...
    together: bool = False  # ... or, if true, one over all of them
    metric: str
    variant: str
    over: Annotated[list[str], AfterValidator(once)]  # a part for each; empty: over 0

    @model_validator(mode="after")
    def _over_others(self) -> "PartsConfig":
        if self.variant in self.over:
            raise ValueError(f"over has the variant itself, {self.variant!r}")
        return self

    def each(self, table1: Table1Config) -> list[Part]:
        """The parts: environment by environment, in each the variants that it is over."""
        parts = []
        for group in [self.environments] if self.together else [[env] for env in self.environments]:
            paper = table1.values_of(group, self.metric)
            for other in self.over or [""]:
                in_paper = float(paper.get(self.variant, math.nan) - paper.get(other, math.nan))
                own = self.metric, self.variant, other or None
                parts.append(Part(tuple(group), *own, in_paper))
        return parts


class ClaimConfig(Section):
    """A claim or a question, and its parts, by one or several of `ways`."""

    statement: str
    parts: Annotated[
        dict[str, Annotated[list[PartsConfig], Field(min_length=1)]], Field(min_length=1)
    ]


class WordsConfig(Section):
    """A family's word for each verdict."""

    shown: str
    reversed: str
    absent: str
    open: str
    no_room: str


class FamilyConfig(Section):
    """Claims whose parts are corrected together; all are measured in the same ways."""

    words: WordsConfig
    claims: Annotated[dict[str, ClaimConfig], Field(min_length=1)]

    @property
    def ways(self) -> list[str]:
        """In which ways its claims are measured."""
        return list(next(iter(self.claims.values())).parts)


class ClaimsConfig(Section):
    """The whole file."""

    variants: dict[str, str] = Field(default={})  # what they are called in few words
    table1: Table1Config
    table2: Table2Config = Field(default=Table2Config())
    ways: dict[str, str]  # to measure a claim, each with what it is for
    families: dict[str, FamilyConfig] = Field(default={})

    def lacking(
        self, environments: Mapping[str, Sequence[str]], settings: MetricsConfig
    ) -> dict[str, list[str]]:
        """By family, what its parts need and a study of these lacks: if nothing, it is judged.

        environments: each with its variants. Parts of returns have their margin by
        `metrics.reference_return` of their environments.
        """
        goal = "metrics.reference_return.{}".format
        measured = {*CORRELATIONS, *(metric.name for metric in all_metrics(settings))}
        found = {}
        for title, family in self.families.items():
            missing, goals = [], []
            for _, part in parts_of(family):
                here = [env for env in part.environments if env in environments]
                missing += [env for env in part.environments if env not in here]
                missing += [
                    variant
                    for variant in (part.variant, *part.over)
                    if any(variant not in environments[env] for env in here)
                ]
                missing += [part.metric] if part.metric not in measured else []
                goals += [goal(env) for env in here if env not in settings.reference_return]
            found[title] = list(dict.fromkeys([*missing, *goals]))
        return found


def parts_of(family: FamilyConfig) -> list[tuple[str, PartsConfig]]:
    """All of a family's parts, each with the key of its claim and way."""
    return [
        (f"{name}.parts.{way}", part)
        for name, claim in family.claims.items()
        for way, parts in claim.parts.items()
        for part in parts
    ]


def undecided(seeds: Sequence[int]) -> str:
    """What has no verdict where parts, or environments, have so many seeds each; "" if all have."""
    if max(seeds) < FEWEST_SEEDS:
        few = f"that takes {FEWEST_SEEDS} seeds, and there are {max(seeds)}"
        return f"no claim can have a verdict: {few}"
    fewer = f"parts with fewer than {FEWEST_SEEDS} seeds stay open"
    return fewer if min(seeds) < FEWEST_SEEDS else ""


def parse_claims(path: str | Path, learned: str = LEARNED) -> ClaimsConfig:
    """The file at `path`, with `learned` as the learned β; a `ConfigError` with its first mistake.

    The file calls that `LEARNED`. Another variant takes its place in every claim and in Table 1.
    """
    return with_learned(read_yaml(Path(path)), learned, str(path))


def with_learned(given: Settings, learned: str, origin: str) -> ClaimsConfig:
    """The same from what `origin`, a file, has."""
    renamed = {key: _renamed(given[key], learned) for key in {"families", "table1"} & {*given}}
    return check(ClaimsConfig, {**given, **renamed}, origin)


def _renamed(part: Any, learned: str) -> Any:
    """Plain settings with another name for the learned β."""
    if isinstance(part, dict):
        return {_renamed(key, learned): _renamed(x, learned) for key, x in part.items()}
    if isinstance(part, list):
        return [_renamed(each, learned) for each in part]
    return learned if part == LEARNED else part


def read_claims(study: "Study", path: str | Path) -> ClaimsConfig:
    """The file that a study names, checked against it; a `ConfigError` with its first mistake."""
    claims = parse_claims(path, study.metrics.learned)
    try:
        _check_names(claims, study)
        _check_form(claims)
        require_latex(claims.table1.caption, "table1.caption")
        for key, names in claims.table2.model_dump().items():
            for name in names.values():
                require_latex(name, f"table2.{key}")
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return claims


def _check_names(claims: ClaimsConfig, study: "Study") -> None:
    """Refuse a metric, variant, environment, way or setting that there is not."""
    from mace_rl.environments import registered  # Gymnasium, which tables do without

    measured = all_metrics(study.metrics.within(study.variants_of))
    metrics = [metric.name for metric in (*METRICS, *measured)]
    own = {*study.environments, *study.environment_settings}
    known: dict[str, tuple[Iterable[str], str]] = {
        "metric": ([*metrics, *CORRELATIONS], "the metrics"),
        "measured": ([metric.name for metric in measured], "what this study measures"),
        "variant": ([*claims.variants, *study.variant_settings], "variants and variant_settings"),
        "environment": ([*registered(), *own], "Gymnasium's registry"),
        "way": (claims.ways, "ways"),
        "setting": (PPOConfig.model_fields, "the settings of ppo"),
    }
    for key, kind, names in _names(claims):
        for name in names:
            if not (kind == "environment" and ":" in name):  # of another study's own
                check_known(name, known[kind][0], key, known[kind][1])


def _names(claims: ClaimsConfig) -> Iterator[tuple[str, str, Iterable[str]]]:
    """What the file names: key, kind and names."""
    table1 = claims.table1
    yield "table1.metrics", "measured", table1.metrics
    yield "table1.public_code", "measured", table1.public_code
    yield "table1.variants", "variant", table1.variants
    yield "table1.values", "environment", table1.values
    yield "table2", "setting", [*claims.table2.rows, *claims.table2.others]
    for title, family in claims.families.items():
        for name, claim in family.claims.items():
            yield f"families.{title}.claims.{name}.parts", "way", claim.parts
        for key, part in parts_of(family):
            key = f"families.{title}.claims.{key}"
            yield f"{key}.environments", "environment", part.environments
            yield f"{key}.metric", "metric", [part.metric]
            yield f"{key}.variant", "variant", [part.variant]
            yield f"{key}.over", "variant", part.over


def _check_form(claims: ClaimsConfig) -> None:
    """Refuse a Table 1 with holes, and claims that cannot be told apart or judged together."""
    table1, seen = claims.table1, set()
    read = [*zip(table1.public_code, table1.metrics, strict=False)]
    if table1.public_code and not (
        len(table1.public_code) == len(table1.metrics)
        and all(table1.metric_of(reading) == metric for reading, metric in read)
    ):
        raise ConfigError(
            f"table1.public_code is {table1.public_code}, but should be a reading of each of"
            f" {table1.metrics}, in this order, or nothing"
        )
    for environment, rows in table1.values.items():
        for variant in {*rows, *table1.variants}:
            numbers = rows.get(variant, [])
            if variant not in table1.variants or len(numbers) != len(table1.metrics):
                raise ConfigError(
                    f"table1.values.{environment}.{variant} is {numbers}, but each of"
                    f" table1.variants, and no other, should have {len(table1.metrics)} numbers"
                )
    if taken := {field.name for field in fields(Answer)}.intersection(claims.ways):
        raise ConfigError(f"ways has {min(taken)!r}, which claims.json has a key for already")
    for title, family in claims.families.items():
        for name, claim in family.claims.items():
            key = f"families.{title}.claims.{name}"
            if name in seen:
                raise ConfigError(f"{key} is there twice, but each claim should have its own name")
            seen.add(name)
            if list(claim.parts) != family.ways:
                raise ConfigError(
                    f"{key}.parts has {list(claim.parts)}, but should have {family.ways} as the"
                    " first of its family"
                )
            for way, parts in claim.parts.items():
                each = [part[:-1] for several in parts for part in several.each(table1)]
                if len(set(each)) < len(each):
                    raise ConfigError(f"{key}.parts.{way} has a part twice")
