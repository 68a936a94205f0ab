"""Reading YAML from files and the command line, and merging it."""

import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from mace_rl.config.section import ConfigError, short_repr

Settings = dict[str, Any]

# The project's config.yaml; an installation has a copy.
DEFAULTS = Path(__file__).with_name("defaults.yaml").resolve()


def read_yaml(path: Path) -> Settings:
    """The mapping in a YAML file; `ConfigError` if there is none or a key occurs twice."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    values = _read(text, str(path))
    if not isinstance(values, dict):
        found = "empty" if values is None else short_repr(values)
        raise ConfigError(f"{path}: it is {found}, but should be keys with values")
    return values


def read_options(options: Iterable[str]) -> Settings:
    """The settings in `--config KEY=VALUE ...`, read as in a file; texts stay as typed."""
    settings: Settings = {}
    for option in options:
        key, given, text = option.partition("=")
        if not given or not re.fullmatch(r"[A-Za-z_]\w*", key):
            raise ConfigError(f"--config has {option!r}, but should have KEY=VALUE")
        value = _read(text, f"--config {key}")
        plain = isinstance(value, str) and text.lstrip()[0] not in "\"'"
        settings = merge(settings, {key: text if plain else value})
    return settings


def merge(
    base: Mapping[str, Any], over: Mapping[str, Any], whole: Collection[str] = ()
) -> Settings:
    """`base` with `over` read over it. Mappings merge, but for the keys `whole`."""
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping) and key not in whole:
            value = merge(below, value)
        merged[key] = value
    return merged


def _read(text: str, origin: str) -> Any:
    """The value of a YAML text; a `ConfigError` with the place of the first mistake."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ConfigError(f"{origin}{place}: not valid YAML: {problem}") from None


DEEPEST, MOST = 50, 100_000  # levels of nesting, and values that aliases repeat

# Scalars that are not text. In YAML 1.1 no, 1_000, 012, 1:30 and dates would be here, too.
_SCALARS = [
    (f"tag:yaml.org,2002:{name}", re.compile(rf"({pattern})\Z", re.ASCII))
    for name, pattern in (
        ("null", r"~|null|Null|NULL|"),
        ("bool", r"true|True|TRUE|false|False|FALSE"),
        ("int", r"[-+]?(0|[1-9]\d{0,99})"),
        ("float", r"[-+]?(?=.*[.eE])((0|[1-9]\d*)(\.\d*)?|\.\d+)([eE][-+]?\d+)?"),
        ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"),
        ("merge", "<<"),
    )
]


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, with the scalars of YAML 1.2.

    It refuses repeated keys, lists or mappings as keys, tags, and too much depth or repetition.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self.yaml_implicit_resolvers = {None: _SCALARS}  # whatever the first character
        self.depth = self.count = 0
        self.sizes: dict[yaml.Node | None, int] = {}  # values in each complete node

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event, before = self.peek_event(), self.count  # type: ignore[no-untyped-call]
        alias, tag = isinstance(event, yaml.AliasEvent), getattr(event, "tag", None)
        self.depth, self.count = self.depth + 1, self.count + 1
        _refuse(self.depth > DEEPEST, f"more than {DEEPEST} levels", event)
        _refuse(tag is not None, f"the tag {tag!r}", event)
        node = super().compose_node(parent, index)
        self.count += self.sizes.get(node, MOST) if alias else 0  # MOST: of a node that contains it
        _refuse(alias and self.count > MOST, "aliases that stand for too much", event)
        self.sizes.setdefault(node, self.count - before)
        self.depth -= 1
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node, seen = super().compose_mapping_node(anchor), set()
        for key, _ in node.value:
            _refuse(not isinstance(key, yaml.ScalarNode), "a key that is a list or mapping", key)
            _refuse((key.tag, key.value) in seen, f"the key {key.value!r} occurs twice", key)
            seen.add((key.tag, key.value))
        return node


def _refuse(wrong: bool, problem: str, where: Any) -> None:
    if wrong:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=where.start_mark)
