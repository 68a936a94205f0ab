"""Reading YAML files, and reading one over another."""

from collections.abc import Collection, Hashable, Mapping
from pathlib import Path
from typing import Any

import yaml

from mace_rl.config.section import ConfigError, short

Settings = dict[str, Any]

# Every default: in the project the file config.yaml, of which an installation has a copy.
DEFAULTS = Path(__file__).with_name("defaults.yaml").resolve()


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
        found = "empty" if values is None else short(values)
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
        if isinstance(below, Mapping) and isinstance(value, Mapping) and key not in whole:
            merged[key] = merge(below, value)
        else:
            merged[key] = value
    return merged


def merge_layers(base: Mapping[str, Any], over: Mapping[str, Any]) -> Settings:
    """`merge` for settings of runs: `beta` is replaced, and `bonus` if its `kind` is another.

    The keys of one kind mean nothing to another.
    """
    bonuses = [bonus for bonus in (base.get("bonus"), over.get("bonus")) if bonus is not None]
    kinds = [bonus.get("kind") for bonus in bonuses if isinstance(bonus, Mapping)]
    same = len(kinds) < 2 or kinds[1] in (kinds[0], None)
    return merge(base, over, whole={"beta"} if same else {"beta", "bonus"})


def typed(value: Any) -> Any:
    """`value` with the texts inside its mappings and lists read as YAML: ["0"] becomes [0]."""

    def read(item: Any) -> Any:
        return yaml.safe_load(item) if isinstance(item, str) else typed(item)

    if isinstance(value, Mapping):
        return {key: read(item) for key, item in value.items()}
    return [read(item) for item in value] if isinstance(value, list) else value


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
