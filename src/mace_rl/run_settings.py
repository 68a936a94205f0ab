"""The settings of a run, by environment and variant: `config.yaml`, and YAML files read over it.

Planning the workflow imports this module, so it stays clear of torch and numba.
"""

import importlib.util
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, reduce
from numbers import Integral
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from pydantic import Field, ValidationError

from mace_rl.config.beta import MetaConfig
from mace_rl.config.bonus import BonusConfig, MemoryConfig, NoveltyConfig
from mace_rl.config.plugins import import_module, source_files
from mace_rl.config.reading import Settings, merge, read_yaml
from mace_rl.config.run import IDENTITY, RunConfig, unused_sections
from mace_rl.config.section import ConfigError, Section, check, check_known, explain, short_repr
from mace_rl.environments import registered, spec_of

# Environments and variants name folders and appear in Snakemake's patterns. An environment may have
# more, as in Gymnasium: package.module:Namespace/Id.
SAFE_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]*"
# What a study's file has besides; `mace_study.config.study` reads it.
OF_A_STUDY = {"results", "replace", "environments", "variants", "seeds"}
OF_A_STUDY |= {"environment_variants", "environment_seeds", "metrics", "figure", "claims"}

# What names of environments have in them, the package that registers them, and our extra.
PACKAGES = (("Bullet", "pybullet_envs_gymnasium", "study"), ("MiniGrid", "minigrid", "minigrid"))


class Variant(Section):
    """One variant: how it is shown; its settings go over `training` and the environment's."""

    model_config = Section.model_config | {"extra": "allow"}

    label: str | None = None  # as plain text; None: its name
    colour: str | None = None  # one of Matplotlib's; None: one that no other variant has

    @property
    def settings(self) -> Settings:
        """The settings of its runs."""
        return dict(self.model_extra or {})


class RunSettings(Section):
    """The settings of all runs that there can be."""

    training: Settings  # hyperparameters of every run ...
    environment_settings: dict[str, Settings]  # ... changed for an environment ...
    variant_settings: Mapping[str, Variant]  # ... and for a variant

    @cached_property
    def _resolved(self) -> dict[tuple[str, str], RunConfig]:
        """What `run_config` has found so far, for seed 0."""
        return {}

    def run_config(
        self, environment: str, variant: str, seed: int, changes: Settings | None = None
    ) -> RunConfig:
        """The settings of one run: `training`, the environment's, the variant's, then `changes`.

        They need no place in the study's lists. Raises `ConfigError` for what cannot be.
        """
        found = None if changes else self._resolved.get((environment, variant))
        if found is None:
            check_known(variant, self.variant_settings, "variant", "variant_settings")
            found = _resolve(self, environment, variant, changes or {})
            if not changes:
                self._resolved[environment, variant] = found
        if not isinstance(seed, Integral) or isinstance(seed, bool) or not 0 <= seed < 2**32:
            raise ConfigError(f"seed is {seed!r}, but should be an integer from 0 to 4294967295")
        return found.model_copy(update={"seed": int(seed)})


def read_settings(paths: Sequence[Path]) -> RunSettings:
    """Those of one YAML file and others read over it: mappings merge, lists are replaced.

    Each run is checked when it is asked for, and packages that others need may be missing. Raises
    `ConfigError` as `read_yaml` does.
    """
    config: Settings = reduce(merge, map(read_yaml, paths), {})
    own = {key: value for key, value in config.items() if key not in OF_A_STUDY}
    return check(RunSettings, own, " + ".join(map(str, paths)))


class LeftOut(Section):
    """The sections that some variants do not use: one that is given is checked all the same."""

    bonus: BonusConfig | None = Field(default=None, discriminator="kind")
    memory: MemoryConfig | None = None
    novelty: NoveltyConfig | None = None
    meta: MetaConfig | None = None


def _resolve(given: RunSettings, environment: str, variant: str, changes: Settings) -> RunConfig:
    """The checked settings of one environment and variant, for seed 0."""
    layers = {
        "training": given.training,
        f"environment_settings.{environment}": given.environment_settings.get(environment, {}),
        f"variant_settings.{variant}": given.variant_settings[variant].settings,
    }
    if changes:
        layers["the changes"] = changes
    for name, layer in layers.items():
        for key in IDENTITY:
            if key in layer:
                raise ConfigError(
                    f"{name}.{key} is {short_repr(layer[key])}, but the lists environments, "
                    "variants and seeds say which runs there are"
                )
    settings = reduce(merge_layers, layers.values())
    settings |= {"environment": environment, "variant": variant, "seed": 0}
    check_name(environment, "environment")
    check_name(variant, "variant")
    try:
        config = RunConfig.model_validate(settings)
    except ValidationError as error:
        location = error.errors(include_url=False)[0]["loc"]
        depths = {name: _depth(layers[name], location) for name in reversed(layers)}
        name = max(depths, key=depths.__getitem__)
        if not location:  # what several keys say together
            name = f"the settings of {environment} and {variant}"
        elif not depths[name]:  # what no layer has
            name = f"variant_settings.{variant}"
        raise ConfigError(f"in {name}, {explain(error, RunConfig)}") from None
    for key, reference in config.references().items():
        source_files(reference, f"in the settings of {environment} and {variant}, {key}")
    unused = unused_sections(config)
    for section, reason in unused.items():
        if given.variant_settings[variant].settings.get(section) is not None:
            raise ConfigError(
                f"variant_settings.{variant} has the section {section!r}, which a variant with "
                f"{reason} does not use"
            )
    left_out = {name: settings[name] for name in unused if changes.get(name) is not None}
    check(LeftOut, left_out, "in the changes")
    return _with_time_limit(config, _registered(config))


def merge_layers(base: Mapping[str, Any], over: Mapping[str, Any]) -> Settings:
    """`merge` for settings of runs, without what was for another rule, bonus or network.

    `beta` is replaced, `bonus` and `ppo.network` are if their `kind` changes, and `arguments` stay
    with their `estimator`.
    """

    def part(settings: Any, *keys: str) -> Any:
        for key in keys:
            settings = settings.get(key) if isinstance(settings, Mapping) else None
        return settings

    def changes(*keys: str) -> bool:
        old, new = part(base, *keys[:-1]), part(over, *keys)
        return isinstance(old, Mapping) and new is not None and old.get(keys[-1]) != new

    left_out = [("ppo", "network")] if changes("ppo", "network", "kind") else []
    left_out += [
        (section, "arguments") for section in ("bonus", "novelty") if changes(section, "estimator")
    ]
    for section, key in left_out:
        kept = {name: value for name, value in base[section].items() if name != key}
        base = {**base, section: kept}
    return merge(base, over, whole={"beta", "bonus"} if changes("bonus", "kind") else {"beta"})


def _depth(layer: Any, location: Iterable[Any]) -> int:
    """How many keys on the way to `location` the layer has itself."""
    depth = 0
    for key in location:
        if isinstance(layer, Mapping) and key in layer:
            layer, depth = layer[key], depth + 1
    return depth


def check_name(name: str, key: str) -> None:
    """`ConfigError` unless the name of an environment or a variant can be a folder's."""
    extra = rf"({SAFE_NAME}:)?({SAFE_NAME}/)?" if key == "environment" else ""
    if not re.fullmatch(rf"{extra}{SAFE_NAME}", name) or len(name) > 200:
        raise ConfigError(
            f"{key} has {short_repr(name)}, but a name here becomes a folder: it should be "
            "up to 200 letters, digits, '.', '_' and '-', and begin with a letter or digit; before "
            "an environment's may stand a module and ':', then a namespace and '/'"
        )


def _registered(config: RunConfig) -> EnvSpec:
    """Its environment in Gymnasium's registry; `ConfigError` if that cannot be made."""
    name, key = config.environment, "environment"
    if ":" in name:
        import_module(name, key)  # which registers it
    own = name.rpartition(":")[2]
    if spec_of(own) is None:
        for part, package, extra in PACKAGES:
            if part in own and importlib.util.find_spec(package) is None:
                raise ConfigError(
                    f"{key} has {name!r}, but the package it needs should be installed: "
                    f"mace-rl's extra [{extra}] has it"
                )
        hint = "" if ":" in name else f" (if a module registers it: module:{name})"
        check_known(own, registered(), key, f"Gymnasium's registry{hint}")
    spec = gymnasium.registry[own]
    if isinstance(spec.entry_point, str):
        try:  # imports the packages around the environment's module, not that module
            importlib.util.find_spec(spec.entry_point.partition(":")[0])
        except (ImportError, gymnasium.error.Error) as error:
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"{key} has {name!r}, but the package it needs should be installed: {reason}"
            ) from None
    return spec


def _with_time_limit(config: RunConfig, spec: EnvSpec) -> RunConfig:
    """Also where only the environment itself has one, `max_steps`, as MiniGrid's do; or none."""
    if config.max_episode_steps or spec.max_episode_steps:
        return config
    from mace_rl.environments.environment import trying_out  # numba takes a second

    name = config.environment
    with trying_out(f"environment {name!r}"):
        env = gymnasium.make(spec, disable_env_checker=True, **config.environment_arguments)
        limit = getattr(env.unwrapped, "max_steps", None)
        env.close()
    if not isinstance(limit, Integral) or isinstance(limit, bool):
        return config
    return config.model_copy(update={"max_episode_steps": int(limit)})
