"""Finished runs: whether a folder has one, and what it recorded."""

import csv
from pathlib import Path
from typing import Any, get_type_hints

from mace_rl import files
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError, check
from mace_rl.runs.provenance import file_digest, read_record
from mace_rl.runs.records import EpisodeRecord

WAY_OUT = "choose another folder, or set this run aside: --restart (in a program restart=True)"


def read_rows(path: Path) -> list[EpisodeRecord]:
    """The `episodes.csv` of a run that is known to be whole, without pandas."""
    types = get_type_hints(EpisodeRecord)
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        return [EpisodeRecord(**{name: types[name](row[name]) for name in types}) for row in rows]


def finished(config: RunConfig, directory: Path) -> bool:
    """Whether `directory` holds the results of this run, whole and as it would come out now.

    Raises `ConfigError` if they are damaged, of another run, or of other code or versions, as a
    checkpoint of those is not continued.
    """
    if not (directory / files.RECORD).exists():
        return False
    content = read_record(directory / files.RECORD)
    # PyTorch takes seconds.
    from mace_rl.runs.run import run_identity

    wanted = run_identity(config)
    found = {key: content[key] for key in wanted}
    found["config"] = check(RunConfig, found["config"], str(directory / files.RECORD)).settings()
    if found != wanted:
        what = f"a finished run {otherwise(found, wanted, config)}"
        raise ConfigError(f"{directory} holds {what}; {WAY_OUT}")
    for path in (directory / name for name in files.RESULTS):
        if not path.exists() or file_digest(path) != content["outputs"].get(path.name):
            raise ConfigError(
                f"{path}: missing, cut off or altered (SHA-256 not as in run.json); {WAY_OUT}"
            )
    return True


def otherwise(found: dict[str, Any], wanted: dict[str, Any], config: RunConfig) -> str:
    """In words, how the run with the identity `found` differs from the `wanted` one of `config`."""
    from mace_rl.runs.checkpoint import difference

    code = " or ".join([*config.references().values(), "mace_rl"])
    only_code = found | {"sources": wanted["sources"]} == wanted
    return f"of other code, in {code}" if only_code else f"where {difference(found, wanted)}"
