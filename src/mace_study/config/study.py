"""The study: which runs there are, with which hyperparameters, and how they are evaluated.

Planning the workflow imports this module, so it stays clear of torch and numba.
"""

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from colorsys import hsv_to_rgb
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from mace_rl.config.plugins import load
from mace_rl.config.reading import Settings, merge, read_yaml
from mace_rl.config.section import ConfigError, check, check_known
from mace_rl.environments import registered
from mace_rl.run_settings import RunSettings, Variant, check_name
from mace_study.config.labels import require_latex
from mace_study.config.metrics import GOALS, FigureConfig, MetricsConfig, Names, once

# What the figures' font has; Matplotlib leaves out of legends what begins with '_'.
LETTERS, SIGNS = r" -\u02af\u0370-\u037e\u0384-\u045f\u0490\u0491", r"\u2010-\u20b5\u2190-\u22ff"
LABEL = rf"(?![_ ])[{LETTERS}{SIGNS}]{{1,60}}(?<! )"


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


class ShownVariant(Variant):
    """A variant with a label that tables and figures can set."""

    label: Annotated[str, AfterValidator(_label)] | None = None
    imported: bool = False  # whether its runs are others', brought by `mace_study.imported`


Seed = Annotated[int, Field(ge=0, lt=2**32)]
SEEDS = r"(\d{1,10})-(\d{1,10})"
Range = Annotated[str, Field(pattern=f"^{SEEDS}$")]
MOST_SEEDS = 100_000  # of one environment


def _listed(seeds: Any) -> Any:
    """Seeds with `FIRST-LAST` written out, alone or in a list."""
    listed = []
    for seed in seeds if isinstance(seeds, list) else [seeds]:
        ends = re.fullmatch(SEEDS, seed, re.ASCII) if isinstance(seed, str) else None
        if not ends:
            if isinstance(seed, str) and not seed.isdecimal():
                raise ValueError(f"{seed!r} should be a number, or FIRST-LAST")
            listed.append(seed)
            continue
        first, last = map(int, ends.groups())
        if not first <= last < first + MOST_SEEDS:
            raise ValueError(f"{seed!r} should be FIRST-LAST, of at most {MOST_SEEDS} seeds")
        listed += range(first, last + 1)
    return listed


Seeds = Annotated[
    list[Seed],
    Field(min_length=1),
    AfterValidator(once),
    BeforeValidator(_listed, json_schema_input_type=Seed | Range | list[Seed | Range]),
]


class Study(RunSettings):
    """All runs of a study, each environment × variant × seed, and how they are evaluated.

    Seeds are numbers, `FIRST-LAST` with both ends, or a list of these.
    """

    results: Annotated[str, AfterValidator(_folder)]  # of everything that is produced
    # Whether finished runs in `results` that have other settings are set aside and trained anew.
    replace: bool = False
    environments: Names
    variants: Names
    seeds: Seeds
    # Other variants, and seeds, for some environments: where one run takes long, say.
    environment_variants: dict[str, Names] = Field(default={})
    environment_seeds: dict[str, Seeds] = Field(default={})
    variant_settings: Mapping[str, ShownVariant]
    metrics: MetricsConfig
    figure: FigureConfig
    claims: str  # the file of what the paper says: claims_config.py

    def runs(self) -> list[tuple[str, str, int]]:
        """Environment, variant and seed of every run, in the configured order."""
        return [
            (environment, variant, seed)
            for environment, variants in self.variants_of.items()
            for variant in variants
            for seed in self.environment_seeds.get(environment, self.seeds)
        ]

    @property
    def variants_of(self) -> dict[str, list[str]]:
        """By environment the variants that have runs there, in the order of `variants`."""
        wanted = {
            env: self.environment_variants.get(env, self.variants) for env in self.environments
        }
        return {env: [name for name in self.variants if name in own] for env, own in wanted.items()}

    def trained(self) -> list[str]:
        """The variants whose runs are trained here."""
        return [name for name in self.variants if not self.variant_settings[name].imported]

    def settings_of(self, environment: str, variant: str) -> dict[str, Any]:
        """The settings in the `run.json` of its runs but for seeds and imported runs' episodes."""
        if self.variant_settings[variant].imported:
            return {"environment": environment, "variant": variant, "imported": True}
        return self.run_config(environment, variant, 0).settings()

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


def load_study(config: Mapping[Any, Any], origin: str) -> Study:
    """Check a configuration, every run's settings included; `origin` begins a `ConfigError`."""
    from matplotlib.colors import is_color_like

    study = check(Study, {str(key): value for key, value in config.items()}, origin)
    try:
        for variant in study.variants:
            check_known(variant, study.variant_settings, "variants", "variant_settings")
        for variant, shown in study.variant_settings.items():
            check_name(variant, "variant_settings")
            require_latex(shown.label or "", f"variant_settings.{variant}.label")
            if shown.colour is not None and not is_color_like(shown.colour):
                raise ConfigError(
                    f"variant_settings.{variant}.colour is {shown.colour!r}, but should be a colour"
                    " of Matplotlib's, such as tab:blue or '#1f77b4'"
                )
        [(label, count)] = Counter(study.labels.values()).most_common(1)
        if count > 1:
            raise ConfigError(f"{count} variants have the label {label!r}; each needs its own")
        for key, variants in {
            "comparisons": itertools.chain.from_iterable(study.metrics.comparisons),
            "constants": study.metrics.constant_variants(),
        }.items():
            for variant in variants:
                check_known(variant, study.variant_settings, f"metrics.{key}", "variant_settings")
        known = dict.fromkeys([*study.environments, *study.environment_settings])
        trained_in = known if study.trained() else study.environment_settings
        for variant, shown in study.variant_settings.items():
            for environment in () if shown.imported else trained_in:
                study.run_config(environment, variant, 0)  # checks its settings
        for environment, variants in study.environment_variants.items():
            for variant in variants:
                key = f"environment_variants.{environment}"
                check_known(variant, study.variant_settings, key, "variant_settings")
        for environment in study.environments:
            study.metrics.random_return_in(environment)  # there has to be one
        for environment, variants in study.variants_of.items():
            if not variants:
                raise ConfigError(
                    f"environment_variants.{environment} has none of variants, {study.variants}"
                )
        by_environment = {
            "environment_seeds": study.environment_seeds,
            "environment_variants": study.environment_variants,
            **{f"metrics.{key}": getattr(study.metrics, key) for key in ("random_return", *GOALS)},
        }
        for key, environments in by_environment.items():  # a study of others may be below
            for environment in environments:
                if environment not in known and ":" not in environment:
                    check_known(environment, registered(), key, "Gymnasium's registry")
        for reference in study.metrics.custom:
            load(reference, "metrics.custom")
    except ConfigError as error:
        raise ConfigError(f"{origin}: {error}") from None
    return study


def read_study(paths: Sequence[Path]) -> Study:
    """The study of one YAML file and others read over it: mappings merge, lists are replaced.

    Raises `ConfigError` as `read_yaml` and `load_study` do.
    """
    config: Settings = reduce(merge, map(read_yaml, paths), {})
    return load_study(config, " + ".join(map(str, paths)))
