"""The study: which runs there are, with which hyperparameters, and how they are evaluated.

`config.yaml`, with the files read over it, is checked here as a whole before any job starts. This
module is imported whenever the workflow is planned, so it stays clear of torch and numba.
"""

import difflib
import importlib.util
import re
from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import pybullet_envs_gymnasium  # noqa: F401  (registers HopperBulletEnv-v0 and its siblings)
import yaml
from matplotlib.colors import is_color_like
from pydantic import Field, ValidationError

from mace_rl.figures import FigureConfig
from mace_rl.hyperparameters import ConfigError, RunConfig, Section, explain
from mace_rl.metrics import MetricsConfig, random_return

# What identifies a run; every other key of RunConfig is a setting.
IDENTITY = ("environment", "variant", "seed")

# Environments and variants name folders and appear in Snakemake's patterns.
SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

Settings = dict[str, Any]


class Study(Section):
    """All runs of a study, every environment × variant × seed, and how they are evaluated."""

    results: str  # folder of everything that is produced
    environments: list[str] = Field(min_length=1)
    variants: list[str] = Field(min_length=1)
    seeds: list[Annotated[int, Field(ge=0, lt=2**32)]] = Field(min_length=1)
    training: Settings  # hyperparameters of every run ...
    environment_settings: dict[str, Settings]  # ... changed for an environment ...
    variant_settings: dict[str, Settings]  # ... and for a variant
    metrics: MetricsConfig
    figure: FigureConfig
    labels: dict[str, str]  # the variants' names in tables and figures
    colours: dict[str, str]  # the variants' colours, as Matplotlib names them

    @cached_property
    def _combinations(self) -> dict[tuple[str, str], RunConfig]:
        """The checked settings of every environment and variant, selected or not, for seed 0."""
        environments = dict.fromkeys([*self.environments, *self.environment_settings])
        return {
            (environment, variant): _resolve(self, environment, variant)
            for environment in environments
            for variant in self.variant_settings
        }

    def run_config(self, environment: str, variant: str, seed: int) -> RunConfig:
        """The settings of one run: `training`, then the environment's, then the variant's.

        The environment and the variant need settings, not a place in the study's lists. Raises
        `ConfigError` for a seed out of range and, if they are new to the study, for what
        `load_study` would refuse in an environment or a variant.
        """
        if (environment, variant) not in self._combinations:
            _check_environment(environment, "environment")
            _check_known(variant, self.variant_settings, "variant", "variant_settings")
            template = _resolve(self, environment, variant)
        else:
            template = self._combinations[environment, variant]
        if not 0 <= seed < 2**32:
            raise ConfigError(f"seed is {seed}, but should be from 0 to 4294967295")
        return template.model_copy(update={"seed": seed})


def load_study(config: Any, origin: str) -> Study:
    """Check a configuration as a whole, every run's settings included.

    `origin` (file names) starts the message of the `ConfigError`, one line with the key, the value
    and what would be right, that the first mistake raises.
    """
    try:
        if not isinstance(config, Mapping):
            raise ConfigError(f"it is {_short(config)}, but should be keys with values")
        study = _validated(Study, {str(key): value for key, value in config.items()})
        _check_results(study.results)
        for key in ("environments", "variants", "seeds"):
            repeated = [name for name, n in Counter(getattr(study, key)).items() if n > 1]
            if repeated:
                values = _short(getattr(study, key))
                raise ConfigError(f"{key} is {values}, but {repeated[0]!r} should be there once")
        for environment in study.environments:
            _check_environment(environment, "environments")
            random_return(study.metrics, environment)  # there has to be one
        for environment in study.environment_settings:
            _check_environment(environment, "environment_settings")
        for variant in study.variant_settings:
            _check_name(variant, "variant_settings")
        for key in ("variants", "labels", "colours"):
            for variant in getattr(study, key):
                _check_known(variant, study.variant_settings, key, "variant_settings")
        for variant in study.variants:
            for key in ("labels", "colours"):
                if variant not in getattr(study, key):
                    raise ConfigError(f"{key}.{variant} is missing, and {variant!r} is in variants")
        for variant, colour in study.colours.items():
            if not is_color_like(colour):
                raise ConfigError(
                    f"colours.{variant} is {colour!r}, but should be a colour of Matplotlib's, "
                    "such as tab:blue or '#1f77b4'"
                )
        _ = study._combinations  # every run's settings are checked here
    except ConfigError as error:
        raise ConfigError(f"{origin}: {error}") from None
    return study


def read_study(paths: Sequence[Path]) -> Study:
    """The study of one YAML file and others read over it: mappings merge, lists are replaced.

    Raises `ConfigError` for a file that cannot be read or is not a mapping, a key that a file
    gives twice, and everything that `load_study` refuses.
    """
    config: Settings = {}
    for path in paths:
        config = merge(config, read_yaml(path))
    return load_study(config, " + ".join(str(path) for path in paths))


def read_yaml(path: Path) -> Settings:
    """The mapping in a YAML file; `ConfigError` if there is none or a key occurs twice."""
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), _UniqueKeys)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ConfigError(f"{path}{place}: not valid YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(values, dict):
        found = "empty" if values is None else _short(values)
        raise ConfigError(f"{path}: it is {found}, but should be keys with values")
    return values


def merge(
    base: Mapping[str, Any], over: Mapping[str, Any], whole: Collection[str] = ()
) -> Settings:
    """`base` with the values of `over`: mappings merge, all else, and the keys `whole`, replace.

    The same as Snakemake does with `--configfile`.
    """
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        both_mappings = isinstance(below, Mapping) and isinstance(value, Mapping)
        merged[key] = merge(below, value) if both_mappings and key not in whole else value
    return merged


def typed(value: Any) -> Any:
    """`value` with the texts inside its mappings and lists read as YAML: ["0"] becomes [0]."""

    def read(item: Any) -> Any:
        return yaml.safe_load(item) if isinstance(item, str) else typed(item)

    if isinstance(value, Mapping):
        return {key: read(item) for key, item in value.items()}
    return [read(item) for item in value] if isinstance(value, list) else value


def _resolve(study: Study, environment: str, variant: str) -> RunConfig:
    """The checked settings of one environment and variant, for seed 0."""
    layers = {
        "training": study.training,
        f"environment_settings.{environment}": study.environment_settings.get(environment, {}),
        f"variant_settings.{variant}": study.variant_settings[variant],
    }
    settings: Settings = {}
    for name, layer in layers.items():
        for key in IDENTITY:
            if key in layer:
                raise ConfigError(
                    f"{name}.{key} is {_short(layer[key])}, but the lists environments, variants "
                    "and seeds say which runs there are"
                )
        settings = merge(settings, layer, whole={"beta"})
    settings |= {"environment": environment, "variant": variant, "seed": 0}
    try:
        return RunConfig.model_validate(settings)
    except ValidationError as error:
        location = error.errors(include_url=False)[0]["loc"]
        name = max(reversed(layers), key=lambda name: _depth(layers[name], location))
        raise ConfigError(f"in {name}, {_explain(error, RunConfig)}") from None


def _depth(layer: Any, location: Iterable[Any]) -> int:
    """How many keys on the way to `location` the layer has itself."""
    depth = 0
    for key in location:
        if isinstance(layer, Mapping) and key in layer:
            layer, depth = layer[key], depth + 1
    return depth


def _validated(model: type[Section], values: Settings) -> Any:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(_explain(error, model)) from None


def _explain(error: ValidationError, model: type[Section]) -> str:
    """`explain`, with advice for numbers that YAML takes for text."""
    value = error.errors(include_url=False)[0]["input"]
    advice = ""
    if isinstance(value, str) and re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", value):
        number = int(value) if re.fullmatch(r"[-+]?\d+", value) else float(value)
        advice = f" (YAML takes it for text: write {number!r}, without quotes)"
    return explain(error, model) + advice


def _check_results(results: str) -> None:
    if not results.strip() or re.search(r"[{}\n\r\0*?\[\]]", results):
        raise ConfigError(
            f"results is {results!r}, but should be the path of a folder, without {{}}*?[]"
        )
    for path in (Path(results), *Path(results).parents):
        if path.exists() and not path.is_dir():
            raise ConfigError(
                f"results is {results!r}, but should be a folder, and {path} is a file"
            )


def _check_name(name: str, key: str) -> None:
    if not SAFE_NAME.fullmatch(name):
        raise ConfigError(
            f"{key} has {name!r}, but a name here becomes a folder: it should consist of letters, "
            "digits, '.', '_' and '-', and begin with a letter or digit"
        )


def _check_environment(name: str, key: str) -> None:
    _check_name(name, key)
    if name not in gymnasium.registry:
        _check_known(name, list(gymnasium.registry), key, "Gymnasium's registry")
    spec = gymnasium.registry[name]
    if spec.max_episode_steps is None:
        raise ConfigError(
            f"{key} has {name!r}, but an environment should have a time limit (max_episode_steps); "
            "its episodes need not end otherwise"
        )
    if isinstance(spec.entry_point, str):
        try:  # imports the packages around the environment's module, not that module
            importlib.util.find_spec(spec.entry_point.partition(":")[0])
        except (ImportError, gymnasium.error.Error) as error:
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"{key} has {name!r}, but the package it needs should be installed: {reason}"
            ) from None


def _check_known(name: str, known: Iterable[str], key: str, where: str) -> None:
    known = list(known)
    if name not in known:
        nearest = difflib.get_close_matches(name, known, n=1, cutoff=0)
        hint = f"; the nearest there is {nearest[0]!r}" if nearest else ""
        raise ConfigError(f"{key} has {name!r}, which is not in {where}{hint}")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


class _UniqueKeys(yaml.SafeLoader):
    """YAML's safe loader; a key that occurs twice in a mapping is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"the key {key!r} occurs twice", problem_mark=key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)
