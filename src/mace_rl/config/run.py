"""Everything that determines one training run, typed, frozen and checked once.

`config.yaml` has the values and their sources. This module, with `agent`, `bonus` and `beta` beside
it, says what each means and may be. Equal `RunConfig`s and equal code give equal results.
"""

import json
from collections.abc import Mapping
from operator import attrgetter
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PositiveInt, model_validator

from mace_rl.config.agent import PPOConfig, TorchModule
from mace_rl.config.beta import BetaConfig, MetaBeta, MetaConfig
from mace_rl.config.bonus import BonusConfig, MemoryConfig, NoveltyConfig
from mace_rl.config.plugins import call_of
from mace_rl.config.published import COMPUTED, PublishedConfig
from mace_rl.config.section import Arguments, Reference, Section, short_repr

# What identifies a run; every other key of RunConfig is a setting.
IDENTITY = ("environment", "variant", "seed")
SECTIONS = ("bonus", "memory", "novelty", "meta")  # used only by variants with a bonus


def _of_the_constructor(arguments: dict[str, Any]) -> dict[str, Any]:
    if of_gymnasium := {"id", "max_episode_steps", "disable_env_checker"} & set(arguments):
        beside = "max_episode_steps" in of_gymnasium
        raise ValueError(
            f"{min(of_gymnasium)!r} is not for the environment's constructor"
            + beside * "; max_episode_steps is a setting beside environment_arguments"
        )
    if arguments.get("map_name", "") is None and arguments.get("desc") is None:
        raise ValueError(
            "map_name is null, with which FrozenLake draws a map that no seed determines: give desc"
        )
    return arguments


EnvironmentArguments = Annotated[Arguments, AfterValidator(_of_the_constructor)]


def as_shapes(arguments: dict[str, Any]) -> dict[str, Any]:
    """Lists of whole numbers as tuples: run.json has no tuples, and shapes are some."""

    def is_shape(value: Any) -> bool:
        return isinstance(value, list) and value != [] and all(type(one) is int for one in value)

    return {key: tuple(value) if is_shape(value) else value for key, value in arguments.items()}


class WrapperConfig(Section):
    """A Gymnasium wrapper, "module:Class", made as Class(env, **arguments)."""

    wrapper: Reference
    arguments: Arguments = Field(default={})


def _by_name(given: Any) -> Any:
    if not isinstance(given, str):
        return given
    name, arguments = call_of(given)
    return {"wrapper": name, "arguments": arguments}


class AgentConfig(Section):
    """What it takes to play with the agent of a run, whichever version of the method trained it."""

    model_config = Section.model_config | {"extra": "ignore"}

    environment: str
    variant: str
    seed: int = Field(ge=0, lt=2**32)
    episodes: PositiveInt
    max_episode_steps: PositiveInt | None = None  # None: the environment's own time limit
    environment_arguments: EnvironmentArguments = Field(default={})  # for its constructor
    # Around it, the innermost first; None, not [], for what kept runs have no word of.
    environment_wrappers: list[Annotated[WrapperConfig, BeforeValidator(_by_name)]] | None = None
    # None: `mace_rl.training.trainer`; else `mace_rl.published`.
    trainer: Literal["published"] | None = None
    engine: Literal["compiled", "torch"] = "compiled"  # what networks are computed by
    ppo: PPOConfig
    published: PublishedConfig | None = None
    bonus: BonusConfig | None = Field(default=None, discriminator="kind")

    @model_validator(mode="after")
    def _compiled_code_has_no_modules(self) -> "AgentConfig":
        if self.engine == "compiled" and isinstance(self.ppo.network, TorchModule):
            raise ValueError(
                "engine is 'compiled', but should be \"torch\" with ppo.network.kind torch"
            )
        return self

    @property
    def wrappers(self) -> list[tuple[str, dict[str, Any]]]:
        """Those around the environment, the innermost first, with their arguments."""
        return [(one.wrapper, as_shapes(one.arguments)) for one in self.environment_wrappers or ()]


class RunConfig(AgentConfig):
    """One training run: environment, variant, seed and every hyperparameter that it uses.

    `bonus`, `memory`, `novelty` and `meta` are there in variants that use them and
    None in the others, so that a change of what a variant does not use leaves its runs alone.
    """

    model_config = Section.model_config

    memory: MemoryConfig | None = None
    novelty: NoveltyConfig | None = None
    meta: MetaConfig | None = None
    beta: BetaConfig = Field(discriminator="kind")

    @model_validator(mode="before")
    @classmethod
    def _only_what_is_used(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        if values.get("trainer") == "published":
            return {"published": {}} | values
        unused = unused_sections(values)
        values = {"bonus": {"kind": "curiosity"}} | values
        return {key: value for key, value in values.items() if key not in unused}

    @model_validator(mode="after")
    def _what_its_trainer_computes(self) -> "RunConfig":
        for key, value in (COMPUTED if self.trainer else {"published": None}).items():
            if (found := attrgetter(key)(self)) != value:
                wanted = json.dumps(getattr(value, "module", value))
                raise ValueError(
                    f"{key} is {short_repr(found)}, but should be {wanted} with "
                    f"trainer: {self.trainer or 'null'}"
                )
        if self.trainer and self.beta.kind == "custom":
            raise ValueError("beta.kind is 'custom', which trainer: published does not know")
        return self

    @model_validator(mode="after")
    def _all_that_is_used(self) -> "RunConfig":
        if isinstance(self.beta, MetaBeta) and not self.beta.objective and not self.trainer:
            raise ValueError("beta.objective is missing: what the meta network learns from")
        for section in {*SECTIONS} - set(unused_sections(self)):
            if getattr(self, section) is None:
                raise ValueError(f"the section {section!r} is missing")
        return self

    def settings(self) -> dict[str, Any]:
        """Plain values, as in `run.json`, without unused sections."""
        return {name: value for name, value in self.model_dump().items() if value is not None}

    def references(self) -> dict[str, str]:
        """By key, the code that the run names as package.module:Name."""
        found = {
            "environment": self.environment if ":" in self.environment else None,
            "ppo.network.module": getattr(self.ppo.network, "module", None),
            "bonus.estimator": getattr(self.bonus, "estimator", None),
            "novelty.estimator": self.novelty.estimator if self.novelty else None,
            "beta.rule": getattr(self.beta, "rule", None),
        }
        for place, (wrapper, _) in enumerate(self.wrappers):
            found[f"environment_wrappers.{place}"] = wrapper
        return {key: reference for key, reference in found.items() if reference is not None}


def unused_sections(settings: Any) -> dict[str, str]:
    """The sections that a run with these settings, plain or checked, does not use, with reasons."""

    def value(*keys: str) -> Any:
        found = settings
        for key in keys:
            of_mapping = isinstance(found, Mapping)
            found = found.get(key) if of_mapping else getattr(found, key, None)
        return found

    if value("trainer") == "published":
        return dict.fromkeys(SECTIONS, "trainer 'published'")
    beta, bonus = value("beta", "kind"), value("bonus", "kind")
    if beta == "none":
        return dict.fromkeys(SECTIONS, "beta.kind 'none'")
    unused = {"meta": f"beta.kind {beta!r}"} if beta and beta != "meta" else {}
    if value("bonus", "relevance") is False:
        unused["memory"] = "bonus.relevance false"
    if bonus == "custom":
        unused |= dict.fromkeys(("memory", "novelty"), "bonus.kind 'custom'")
    return unused
