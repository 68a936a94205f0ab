"""The study: which runs there are, with which hyperparameters, and how they are evaluated.

Planning the workflow imports this module, so it stays clear of torch and numba.
"""

import importlib.util
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from colorsys import hsv_to_rgb
from functools import cached_property, reduce
from numbers import Integral
from pathlib import Path
from typing import Annotated, Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from pydantic import AfterValidator, Field, ValidationError

from mace_rl.config.beta import MetaConfig, PretrainedConfig
from mace_rl.config.bonus import BonusConfig, MemoryConfig, NoveltyConfig
from mace_rl.config.plugins import import_module, load, source_files
from mace_rl.config.reading import Settings, merge, read_yaml
from mace_rl.config.run import IDENTITY, RunConfig, unused_sections
from mace_rl.config.section import ConfigError, Section, check, check_known, explain, short_repr
from mace_rl.environments import registered
from mace_rl.study.labels import require_latex
from mace_rl.study.metrics_config import GOALS, FigureConfig, MetricsConfig, Names, once

# Environments and variants name folders and appear in Snakemake's patterns. An environment may have
# more, as in Gymnasium: package.module:Namespace/Id.
SAFE_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]*"
# What the figures' font has; Matplotlib leaves out of legends what begins with '_'.
LETTERS, SIGNS = r" -\u02af\u0370-\u037e\u0384-\u045f\u0490\u0491", r"\u2010-\u20b5\u2190-\u22ff"
LABEL = rf"(?![_ ])[{LETTERS}{SIGNS}]{{1,60}}(?<! )"


class LeftOut(Section):
    """The sections that some variants do not use: one that is given is checked all the same."""

    bonus: BonusConfig | None = Field(default=None, discriminator="kind")
    memory: MemoryConfig | None = None
    novelty: NoveltyConfig | None = None
    meta: MetaConfig | None = None
    pretrained: PretrainedConfig | None = None


def _label(text: str) -> str:
    if not (text.isprintable() and re.fullmatch(LABEL, text)):
        raise ValueError(
            "it should be 1 to 60 Latin, Greek or Cyrillic letters, digits and signs on one line,"
            " without '_' before and spaces around them"
        )
    return text


def _folder(path: str) -> str:
    if not path.strip() or re.search(r"[{}\n\r\0*?\[\]]", path):
        raise ValueError("it should be the path of a folder, without {}*?[]")
    if max(map(len, path.encode().split(b"/"))) > 255:
        raise ValueError("its names should be of at most 255 bytes")
    for part in (Path(path), *Path(path).parents):
        if not part.is_dir() and (part.exists() or part.is_symlink()):
            found = "file" if part.exists() else "link that leads nowhere"
            raise ValueError(f"it should be a folder, and {part} is a {found}")
    return path


class Variant(Section):
    """One variant: how it is shown; its settings go over `training` and the environment's."""

    model_config = Section.model_config | {"extra": "allow"}

    label: Annotated[str, AfterValidator(_label)] | None = None  # as plain text; None: its name
    colour: str | None = None  # one of Matplotlib's; None: one that no other variant has

    @property
    def settings(self) -> Settings:
        """The settings of its runs."""
        return dict(self.model_extra or {})


Seeds = Annotated[
    list[Annotated[int, Field(ge=0, lt=2**32)]], Field(min_length=1), AfterValidator(once)
]


class Study(Section):
    """All runs of a study, each environment × variant × seed, and how they are evaluated."""

    results: Annotated[str, AfterValidator(_folder)]  # of everything that is produced
    environments: Names
    variants: Names
    seeds: Seeds
    # Other seeds for some environments, where one run takes long.
    environment_seeds: dict[str, Seeds] = Field(default={})
    training: Settings  # hyperparameters of every run ...
    environment_settings: dict[str, Settings]  # ... changed for an environment ...
    variant_settings: dict[str, Variant]  # ... and for a variant
    metrics: MetricsConfig
    figure: FigureConfig
    claims: str  # the file of what the paper says: study/claims_config.py

    @cached_property
    def _resolved(self) -> dict[tuple[str, str], RunConfig]:
        """What `run_config` has found so far, for seed 0."""
        return {}

    def runs(self) -> list[tuple[str, str, int]]:
        """Environment, variant and seed of every run, in the configured order."""
        return [
            (environment, variant, seed)
            for environment in self.environments
            for variant in self.variants
            for seed in self.environment_seeds.get(environment, self.seeds)
        ]

    @property
    def labels(self) -> dict[str, str]:
        """The names of the study's variants in tables and figures."""
        return {name: self.variant_settings[name].label or name for name in self.variants}

    @property
    def colours(self) -> dict[str, str]:
        """The colours of the study's variants: their own, Matplotlib's ten, then hues far apart."""
        from matplotlib.colors import TABLEAU_COLORS, to_hex

        hues = (hsv_to_rgb(0.618 * n % 1, 1, (0.4, 0.7, 1)[n % 3]) for n in itertools.count())
        given = {name: variant.colour for name, variant in self.variant_settings.items()}
        taken = set(map(to_hex, filter(None, given.values())))
        every = itertools.chain(TABLEAU_COLORS, map(to_hex, hues))
        free = (colour for colour in every if to_hex(colour) not in taken)
        colours = {name: colour or next(free) for name, colour in given.items()}
        return {name: colours[name] for name in self.variants}

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


def load_study(config: Mapping[Any, Any], origin: str) -> Study:
    """Check a configuration, every run's settings included; `origin` begins a `ConfigError`."""
    from matplotlib.colors import is_color_like

    study = check(Study, {str(key): value for key, value in config.items()}, origin)
    try:
        for variant in study.variants:
            check_known(variant, study.variant_settings, "variants", "variant_settings")
        for variant, shown in study.variant_settings.items():
            _check_name(variant, "variant_settings")
            require_latex(shown.label or "", f"variant_settings.{variant}.label")
            if shown.colour is not None and not is_color_like(shown.colour):
                raise ConfigError(
                    f"variant_settings.{variant}.colour is {shown.colour!r}, but should be a colour"
                    " of Matplotlib's, such as tab:blue or '#1f77b4'"
                )
        [(label, count)] = Counter(study.labels.values()).most_common(1)
        if count > 1:
            raise ConfigError(f"{count} variants have the label {label!r}; each needs its own")
        for variant in itertools.chain.from_iterable(study.metrics.comparisons):
            check_known(variant, study.variant_settings, "metrics.comparisons", "variant_settings")
        known = dict.fromkeys([*study.environments, *study.environment_settings])
        for environment, variant in itertools.product(known, study.variant_settings):
            study.run_config(environment, variant, 0)  # checks its settings
        for environment in study.environment_seeds:
            check_known(environment, known, "environment_seeds", "environments")
        for environment in study.environments:
            study.metrics.random_return_in(environment)  # there has to be one
        for key in ("random_return", *GOALS):
            for environment in getattr(study.metrics, key):
                if environment not in known and ":" not in environment:
                    check_known(environment, registered(), f"metrics.{key}", "Gymnasium's registry")
        for reference in study.metrics.custom:
            load(reference, "metrics.custom")
    except ConfigError as error:
        raise ConfigError(f"{origin}: {error}") from None
    return study


def folder_of(environment: str) -> str:
    """What the folder of an environment's runs is called; no id has the '+' that stands for '/'."""
    return environment.replace("/", "+")


def read_study(paths: Sequence[Path], every_run: bool = True) -> Study:
    """The study of one YAML file and others read over it: mappings merge, lists are replaced.

    Without `every_run` each run is checked when it is asked for, and packages that others need may
    be missing. Raises `ConfigError` as `read_yaml` and `load_study` do.
    """
    config: Settings = reduce(merge, map(read_yaml, paths), {})
    origin = " + ".join(str(path) for path in paths)
    return load_study(config, origin) if every_run else check(Study, config, origin)


def _resolve(study: Study, environment: str, variant: str, changes: Settings) -> RunConfig:
    """The checked settings of one environment and variant, for seed 0."""
    layers = {
        "training": study.training,
        f"environment_settings.{environment}": study.environment_settings.get(environment, {}),
        f"variant_settings.{variant}": study.variant_settings[variant].settings,
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
    _check_name(environment, "environment")
    _check_name(variant, "variant")
    try:
        config = RunConfig.model_validate(settings)
    except ValidationError as error:
        location = error.errors(include_url=False)[0]["loc"]
        depths = {name: _depth(layers[name], location) for name in reversed(layers)}
        name = max(depths, key=depths.__getitem__)
        name = name if depths[name] else f"variant_settings.{variant}"  # what no layer has
        raise ConfigError(f"in {name}, {explain(error, RunConfig)}") from None
    for key, reference in config.references().items():
        source_files(reference, f"in the settings of {environment} and {variant}, {key}")
    unused = unused_sections(config)
    for section, reason in unused.items():
        if section in study.variant_settings[variant].settings:
            raise ConfigError(
                f"variant_settings.{variant} has the section {section!r}, which a variant with "
                f"{reason} does not use"
            )
    left_out = {name: settings[name] for name in unused if changes.get(name) is not None}
    check(LeftOut, left_out, "in the changes")
    return _with_time_limit(config, _registered(config))


def merge_layers(base: Mapping[str, Any], over: Mapping[str, Any]) -> Settings:
    """`merge` for settings of runs: `beta` is replaced, and `bonus` if its `kind` changes."""
    bonuses = [bonus for bonus in (base.get("bonus"), over.get("bonus")) if bonus is not None]
    kinds = [bonus.get("kind") for bonus in bonuses if isinstance(bonus, Mapping)]
    same = len(kinds) < 2 or kinds[1] in (kinds[0], None)
    return merge(base, over, whole={"beta"} if same else {"beta", "bonus"})


def _depth(layer: Any, location: Iterable[Any]) -> int:
    """How many keys on the way to `location` the layer has itself."""
    depth = 0
    for key in location:
        if isinstance(layer, Mapping) and key in layer:
            layer, depth = layer[key], depth + 1
    return depth


def _check_name(environment: str, key: str) -> None:
    extra = rf"({SAFE_NAME}:)?({SAFE_NAME}/)?" if key == "environment" else ""
    if not re.fullmatch(rf"{extra}{SAFE_NAME}", environment) or len(environment) > 200:
        raise ConfigError(
            f"{key} has {short_repr(environment)}, but a name here becomes a folder: it should be "
            "up to 200 letters, digits, '.', '_' and '-', and begin with a letter or digit; before "
            "an environment's may stand a module and ':', then a namespace and '/'"
        )


def _registered(config: RunConfig) -> EnvSpec:
    """Its environment in Gymnasium's registry; `ConfigError` if that cannot be made."""
    name, key = config.environment, "environment"
    if ":" in name:
        import_module(name, key)  # which registers it
    own = name.rpartition(":")[2]
    if own not in registered():
        if "Bullet" in own and importlib.util.find_spec("pybullet_envs_gymnasium") is None:
            raise ConfigError(
                f"{key} has {name!r}, but the package it needs should be installed: "
                "mace-rl's extra [study] has it"
            )
        hint = "" if ":" in name else f" (if a module registers it: module:{name})"
        check_known(own, registered(), key, f"Gymnasium's registry{hint}")
    spec = registered()[own]
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
    """Also where only the environment itself has one, `max_steps`, as MiniGrid's do."""
    if config.max_episode_steps or spec.max_episode_steps:
        return config
    from mace_rl.environments.environment import trying_out  # numba takes a second

    name = config.environment
    with trying_out(f"environment {name!r}"):
        env = gymnasium.make(spec, disable_env_checker=True, **config.environment_arguments)
        limit = getattr(env.unwrapped, "max_steps", None)
        env.close()
    if not isinstance(limit, int):
        raise ConfigError(
            f"environment has {name!r}, which has no time limit of its own, so that its episodes "
            f"need not end: --max-episode-steps or environment_settings.{name}.max_episode_steps "
            "should set one"
        )
    return config.model_copy(update={"max_episode_steps": limit})
