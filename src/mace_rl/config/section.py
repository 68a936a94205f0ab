"""The base of every section of the configuration: strict types, and one line for a mistake."""

import difflib
import json
import math
import re
import types
from collections.abc import Iterable
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from mace_rl.base.errors import Refusal

Model = TypeVar("Model", bound=BaseModel)
MOVED = ("icm", "rnd", "hash_counts", "random", "bandit")  # kinds that are plugins now


class ConfigError(Refusal, ValueError):
    """A setting that cannot be used; the message names key, value and what would be right."""


class Section(BaseModel):
    """Base of every configuration section: unknown keys, wrong types, NaN and Inf are errors."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=()
    )


# A number of things, which may all have to fit into memory.
Count = Annotated[int, Field(gt=0, le=10**7)]
Units = Annotated[int, Field(gt=0, le=10**4)]  # in a layer of a network


def _reference(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", text):
        raise ValueError("it should name Python code, as package.module:Name")
    return text


# The user's own code, "package.module:Name"; config/plugins.py says where it is looked for.
Reference = Annotated[str, AfterValidator(_reference)]


def _plain(value: Any, depth: int = 0) -> Any:
    """`value` with Python's numbers for NumPy's; `ValueError` if JSON would change it."""
    value = value.item() if getattr(value, "shape", None) == () else value
    if depth < 100 and isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _plain(item, depth + 1) for key, item in value.items()}
    if depth < 100 and isinstance(value, list | tuple):
        return [_plain(item, depth + 1) for item in value]
    finite = not isinstance(value, float) or math.isfinite(value)
    if finite and (value is None or isinstance(value, bool | int | float | str)):
        return value
    raise ValueError(
        "it should be made of finite numbers, texts, true, false, null, lists and mappings from "
        "texts, as run.json holds them"
    )


# Arguments of the user's own code and of environments, which run.json has to give back unchanged:
# `encode` raises ValueError for half a character. (A lambda: pydantic 2.7 would set `depth`.)
Arguments = Annotated[
    dict[str, Annotated[Any, BeforeValidator(lambda value: _plain(value))]],
    AfterValidator(lambda values: json.loads(json.dumps(values, ensure_ascii=False).encode())),
]


def check(model: type[Model], values: Any, origin: str) -> Model:
    """`model` from `values`; a one-line `ConfigError`, begun by `origin`, for the first mistake."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{origin}: {explain(error, model)}") from None


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first problem of a pydantic `error` on one line: key, value, what would be right."""
    problem = error.errors(include_url=False)[0]
    key, known = _place(model, problem["loc"])
    key = key or "the configuration"
    match problem["type"]:
        case "extra_forbidden":
            nearest = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1, cutoff=0)
            return (
                f"unknown key {key!r} (value {short_repr(problem['input'])}); "
                f"the nearest known key is {nearest[0]!r}"
            )
        case "missing":
            return f"the key {key!r} is missing"
        case _:
            reason = problem["msg"].removeprefix("Value error, ").removeprefix("Input ")
            reason = " ".join(reason.replace(" after validation, not 0", "").split())
            if not problem["loc"]:  # of several keys together, which the reason names
                return reason
            return f"{key} is {short_repr(problem['input'])}, but {reason}{_advice(problem)}"


def short_repr(value: Any) -> str:
    """`repr` of a value, in one line and cut to 60 characters."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # more digits than Python writes
        text = f"too large: {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def _advice(problem: ErrorDetails) -> str:
    """Advice for a value that YAML reads otherwise than it is meant."""
    wanted, value = problem["type"], problem["input"]
    if wanted == "union_tag_invalid" and problem["ctx"]["tag"] in MOVED:
        return ", and extras/ has this one, as kind: custom (docs/extending.md)"
    if wanted == "string_type" and isinstance(value, bool | int | float):
        return " (YAML takes it for text where it stands in quotes)"
    if wanted == "bool_type" and isinstance(value, str):
        return " (write true or false)"
    text = str(value).replace("_", "") if isinstance(value, str | float) else ""
    if re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text):
        number = float(text)
        if wanted == "float_type" or (wanted == "int_type" and number.is_integer()):
            quotes = ", without quotes" if isinstance(value, str) else ""
            return f" (write {short_repr(int(number) if number.is_integer() else number)}{quotes})"
    return ""


def _place(model: type[BaseModel], location: tuple[Any, ...]) -> tuple[str, list[str]]:
    """`location` as in the file, and the known keys of the section of its last element."""
    names: list[str] = []
    beside = candidates = [model]
    for part in location:
        tagged = [candidate for candidate in candidates if part in _kinds(candidate)]
        if tagged:  # the `kind` of a member of a union: the file has no such key
            candidates = tagged
            continue
        names.append(str(part))
        beside = candidates
        fields = [c.model_fields[part] for c in candidates if part in c.model_fields]
        if fields:
            candidates = [one for field in fields for one in _sections(field.annotation)]
    return ".".join(names), list(dict.fromkeys(key for one in beside for key in one.model_fields))


def _kinds(model: type[BaseModel]) -> tuple[Any, ...]:
    """The values of the literal `kind` of one member of a union."""
    field = model.model_fields.get("kind")
    literal = field is not None and get_origin(field.annotation) is Literal
    return get_args(field.annotation) if field is not None and literal else ()


def _sections(annotation: Any) -> list[type[BaseModel]]:
    """The settings classes in a type, also in a union, list or dict."""
    if get_origin(annotation) in (Union, types.UnionType, Annotated, dict, list):
        return [one for argument in get_args(annotation) for one in _sections(argument)]
    is_section = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    return [annotation] if is_section else []


def check_known(name: str, known: Iterable[str], key: str, where: str) -> None:
    """Refuse a name that is not among those `known`, which are defined in `where`."""
    known = list(known)
    if name not in known:
        nearest = difflib.get_close_matches(name, known, n=1)
        hint = f"; the nearest there is {nearest[0]!r}" if nearest else ""
        raise ConfigError(f"{key} has {name!r}, which is not in {where}{hint}")
