"""A finished run on disk: the parts in its folder, each checked when it is first asked for."""

import hashlib
import io
import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from mace_rl.base import code_digest, files
from mace_rl.base.tables import RecordError
from mace_rl.config.plugins import code_outside, load
from mace_rl.config.run import AgentConfig, RunConfig
from mace_rl.config.section import ConfigError, check, short_repr
from mace_rl.runs.provenance import difference, identity, read_record
from mace_rl.training.records import EpisodeRecord, RunKey, as_rows, read_episodes

if TYPE_CHECKING:  # which take a second to import, as PyTorch does
    import pandas as pd

Config = TypeVar("Config", bound=AgentConfig)
ALTERED = "missing, cut off or altered (SHA-256 not as in run.json)"
NEVER_WRITTEN = "not as a training writes it"
WAY_OUT = "choose another folder, or set this run aside: --restart (in a program restart=True)"


class FinishedRun:
    """The finished run in `folder`: each part is whole, or asking for it raises a `Refusal`.

    trust: whether its configuration may name code from outside this package.
    """

    def __init__(self, folder: str | Path, trust: bool = False) -> None:
        self.folder, self.trust = Path(folder), trust

    @classmethod
    def below(cls, folder: Path, trust: bool = False) -> list["FinishedRun"]:
        """Those in and below `folder`, sorted; `RecordError` if there are none."""
        found = files.runs_below(folder, [files.RECORD])
        if not found:
            raise RecordError(f"no finished run in {folder}, or below it")
        return [cls(one, trust) for one in found]

    @cached_property
    def record(self) -> dict[str, Any]:
        """Its `run.json`; `ProvenanceError` if that is missing or damaged."""
        return read_record(self.folder / files.RECORD)

    @cached_property
    def config(self) -> RunConfig:
        """Its configuration, to train by. The code that it names is not imported.

        Raises `ConfigError` if it is wrong, or names code from outside without `trust`.
        """
        return self._checked(RunConfig)

    @cached_property
    def agent_config(self) -> AgentConfig:
        """The same, of what playing needs: other settings may be of another version."""
        return self._checked(AgentConfig)

    def _checked(self, model: type[Config]) -> Config:
        origin, values = str(self.folder / files.RECORD), self.record["config"]
        try:
            config = check(model, values, origin)
        except ConfigError as error:
            if self.record["sources"] == code_digest.digest("training"):
                raise
            reason = f"{error}; this run may be of other code, which took other settings"
            raise ConfigError(reason) from None
        for key, text in ({} if self.trust else code_outside(values)).items():
            raise ConfigError(
                f"{origin}: {key} has {short_repr(text)}, code from outside mace_rl: "
                "if you trust it, give --trust (in a program: trust=True)"
            )
        return config

    def content(self, name: str) -> bytes:
        """One of `files.RESULTS`; `RecordError` unless its digest is in `run.json`."""
        path = self.folder / name
        content = files.content(path) if path.exists() else None
        digest = self.record["outputs"].get(name)
        if content is None or hashlib.sha256(content).hexdigest() != digest:
            raise RecordError(f"{path}: {ALTERED}")
        return content

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """`episodes.csv`, int64 or float64 [episodes]; `RecordError` names the damaged line."""
        path, episodes = self.folder / files.EPISODES, self.record["config"]["episodes"]
        try:
            content = self.content(path.name)
        except (RecordError, OSError):
            if path.exists():
                read_episodes(path, episodes)  # says in which line, if one looks damaged
            raise
        return read_episodes(path, episodes, content)

    @cached_property
    def episodes(self) -> "pd.DataFrame":
        """The same as a frame."""
        import pandas as pd

        return pd.DataFrame(self.columns)

    @cached_property
    def rows(self) -> list[EpisodeRecord]:
        """The same in rows."""
        return as_rows(EpisodeRecord, self.columns)

    @cached_property
    def diagnostics(self) -> "pd.DataFrame | None":
        """`diagnostics.csv`, numbers; None in a kept run without. `RecordError` names the file."""
        import pandas as pd

        path = self.folder / files.DIAGNOSTICS
        if not path.exists():
            return None
        content = io.BytesIO(self.content(path.name))
        try:
            table = pd.read_csv(content, dtype=float)
            if not (table["episode"].between(1, 2**53) & (table["episode"] % 1 == 0)).all():
                raise ValueError("no training writes such episodes")
            return table.astype({"episode": int})
        except (KeyError, ValueError):
            raise RecordError(f"{path}: {NEVER_WRITTEN}") from None

    @cached_property
    def agent_state(self) -> dict[str, Any]:
        """The plain data in `agent.pt`; `CheckpointError` if there is anything else."""
        from mace_rl.runs.checkpoint import unarchive

        return unarchive(self.content(files.AGENT), self.folder / files.AGENT)


def in_the_way(runs: Iterable[tuple[Path, Mapping[str, Any]]]) -> dict[Path, str]:
    """The finished runs in folders where others are to be trained: how their settings differ.

    runs: folders, and `RunConfig.settings` of what is to be trained there. "" for equal settings:
    the code or its versions changed, or somebody wants it again.
    """
    found = {}
    for folder, settings in runs:
        if (folder / files.RECORD).exists():
            own, wanted = read_record(folder / files.RECORD)["config"], dict(settings)
            plain = json.loads(json.dumps(wanted))
            with suppress(ConfigError):  # some settings are of another version
                own = completed(own, plain, str(folder))
            found[folder] = "" if own == plain else difference(own, plain)
    return found


def read_runs(
    records: Iterable[str],
    runs: Iterable[tuple[str, str, int, int]],
    settings: Mapping[tuple[str, str], Mapping[str, Any]],
) -> dict[RunKey, "pd.DataFrame"]:
    """The episodes of each run; raises what `FinishedRun.episodes` raises.

    records: the paths of their `run.json`; runs: their environment, variant, seed and number of
    episodes; settings: `RunConfig.settings` by environment and variant. `RecordError` if a record
    is of another run, or of one with other settings.
    """
    plain = {key: json.loads(json.dumps(own)) for key, own in settings.items()}
    found: dict[RunKey, pd.DataFrame] = {}
    for record, (environment, variant, seed, episodes) in zip(records, runs, strict=True):
        run = FinishedRun(Path(record).parent, trust=True)  # it is only compared
        wanted = plain[environment, variant] | {"seed": seed, "episodes": episodes}
        require_settings(run.record["config"], wanted, record)
        found[environment, variant, seed] = run.episodes
    return found


def require_settings(own: Mapping[str, Any], wanted: Mapping[str, Any], origin: str) -> None:
    """`RecordError`, begun by `origin`, unless a run with the configuration `own` is as `wanted`.

    wanted: plain values.
    """
    if (own := completed(own, wanted, origin)) != wanted:
        raise RecordError(f"{origin} is of another run: {difference(dict(own), dict(wanted))}")


def completed(own: Mapping[str, Any], wanted: Mapping[str, Any], origin: str) -> Mapping[str, Any]:
    """The recorded configuration `own`; unless it is as `wanted`, with defaults for what is new.

    `ConfigError`, begun by `origin`, if it is none today.
    """
    return own if own == wanted else check(RunConfig, own, origin).settings()


def finished(config: RunConfig, directory: Path) -> bool:
    """Whether `directory` holds the results of this run by the present code and versions.

    Not yet, if they are of fewer episodes and a checkpoint is there to go on from. Raises
    `ConfigError` if it holds others, or damaged ones.
    """
    if not (directory / files.RECORD).exists():
        return False
    run = FinishedRun(directory, trust=True)  # it is only compared
    wanted = identity(config)
    try:
        found = {key: run.record[key] for key in wanted} | {"config": run.config.settings()}
    except ConfigError as error:
        raise ConfigError(f"{error}; {WAY_OUT}") from None
    if found != wanted:
        if (
            continues(found, wanted, config)
            and found["config"]["episodes"] < config.episodes
            and (directory / files.CHECKPOINT).exists()
        ):
            return False
        what = f"a finished run {difference_from(found, wanted, config)}"
        raise ConfigError(f"{directory} holds {what}; {WAY_OUT}")
    try:
        for name in files.RESULTS:
            run.content(name)
    except RecordError as error:
        raise ConfigError(f"{error}; {WAY_OUT}") from None
    return True


def difference_from(found: dict[str, Any], wanted: dict[str, Any], config: RunConfig) -> str:
    """How the run with the identity `found` differs from the `wanted` one of `config`, in words."""
    code = " or ".join([*config.references().values(), "mace_rl"])
    if not only_budget(found, wanted):  # what else differs is named first
        found = found | {"config": found["config"] | {"episodes": config.episodes}}
    if found | {"sources": wanted["sources"]} == wanted:
        return f"of other code, in {code}"
    reason = ""
    if found["config"]["episodes"] < config.episodes:
        rule = needs_budget(config)
        reason = ", without a checkpoint to go on from"
        reason = f", which beta.rule {rule!r} needs to know" if rule else reason
    return f"where {difference(found, wanted)}{reason}"


def only_budget(found: dict[str, Any], wanted: dict[str, Any]) -> bool:
    """Whether two identities differ in the number of episodes at most."""
    episodes = {"episodes": wanted["config"]["episodes"]}
    return found | {"config": found["config"] | episodes} == wanted


def needs_budget(config: RunConfig) -> str | None:
    """The rule for β if it depends on how many episodes the run has."""
    rule: str | None = getattr(config.beta, "rule", None)
    return rule if rule and getattr(load(rule, "beta.rule"), "needs_budget", False) else None


def continues(found: dict[str, Any], wanted: dict[str, Any], config: RunConfig) -> bool:
    """Whether a run with the identity `found` is the beginning of the `wanted` one of `config`."""
    return found == wanted or (only_budget(found, wanted) and not needs_budget(config))
