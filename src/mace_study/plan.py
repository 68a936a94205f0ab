"""What a study comes to: its runs, how they are measured, and what can be made of them.

Planning the workflow imports this module, so it stays clear of torch and numba.
"""

import os
import re
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from mace_rl.base import files
from mace_rl.environments import spec_of
from mace_rl.runs.provenance import read_record
from mace_study.compare.claims_config import ClaimsConfig, parts_of, read_claims, undecided
from mace_study.config.metrics import MetricsConfig
from mace_study.config.study import Study
from mace_study.measure.metrics import all_metrics, metric_units, out_of_reach

FIGURES = ("figure1", "figure2")  # over training: 1 is the paper's, 2 shows β


def one_of(values: Iterable[Any]) -> str:
    """A pattern that matches exactly these values, without any nothing."""
    return "|".join(re.escape(str(value)) for value in values) or "(?!)"


class Plan:
    """A study and the file of claims that it names; both are checked."""

    def __init__(self, study: Study, project: Path) -> None:
        """project: where the file of claims is looked for if it is not in the current folder.

        Raises `ConfigError` for metrics, imported runs or claims that do not work.
        """
        self.study = study
        self.measured: MetricsConfig = study.metrics.within(study.variants_of)
        all_metrics(self.measured)  # the user's own among them: are they metrics?
        places = [Path(study.claims), Path(project, study.claims)]
        self.claims = os.path.relpath(next(filter(Path.exists, places), places[0]))
        self.paper: ClaimsConfig = read_claims(study, self.claims)
        self.results = os.path.normpath(study.results)

    # --- Runs -----------------------------------------------------------------------------------

    @cached_property
    def runs(self) -> list[tuple[str, str, int]]:
        """Environment, variant and seed of each."""
        return self.study.runs()

    @cached_property
    def folders(self) -> list[str]:
        """Where each of `runs` is."""
        return [
            f"{self.results}/runs/{files.folder_of(environment)}/{variant}/seed{seed}"
            for environment, variant, seed in self.runs
        ]

    @cached_property
    def trained(self) -> list[str]:
        """The variants whose runs are trained here, not imported."""
        return self.study.trained()

    @cached_property
    def run_settings(self) -> dict[tuple[str, str], dict[str, Any]]:
        """By environment and variant the settings of its runs, whatever the seed."""
        pairs = dict.fromkeys(run[:2] for run in self.runs)
        return {pair: self.study.settings_of(*pair) for pair in pairs}

    @cached_property
    def work(self) -> dict[tuple[str, str], int]:
        """How long runs can take, by environment and variant: in steps of plain PPO, at most."""
        found = {}
        for environment, variant in self.run_settings:
            if variant in self.trained:
                config, spec = self.study.run_config(environment, variant, 0), spec_of(environment)
                limit = config.max_episode_steps or (spec and spec.max_episode_steps) or 1000
                steps = config.episodes * limit
                found[environment, variant] = steps * (1 if config.beta.kind == "none" else 2)
        return found

    @cached_property
    def first_runs(self) -> list[tuple[str, str, int]]:
        """One of each environment, of those that can take longest."""
        longest = {}
        for pair in sorted(self.work, key=self.work.__getitem__):
            longest[pair[0]] = pair
        seeds = {run[:2]: run for run in reversed(self.runs)}
        return [seeds[pair] for pair in longest.values()]

    def priority(self, environment: str, variant: str, seed: int) -> int:
        """Of a run: longer ones start earlier, and no core idles at the end.

        Before all others come `first_runs`: code for several environments is compiled side by side.
        """
        first = (environment, variant, seed) in self.first_runs
        return self.work[environment, variant] + first * max(self.work.values())

    @cached_property
    def with_episodes(self) -> list[tuple[str, str, int, int]]:
        """`runs`, each with how many episodes it has; imported ones have what they have.

        Raises `ProvenanceError` for one that has not been imported.
        """
        found = []
        for run, folder in zip(self.runs, self.folders, strict=True):
            own = self.run_settings[run[:2]].get("episodes")
            own = own or read_record(Path(folder, files.RECORD))["config"]["episodes"]
            found.append((*run, own))
        return found

    # --- What can be made -----------------------------------------------------------------------

    @property
    def has_papers(self) -> bool:
        """Whether there is all that the paper's Table 1 has."""
        return self.paper.table1.is_within(self.study.variants_of)

    @property
    def read(self) -> bool:
        """Whether Table 1 can be read in several ways, as what counts episodes can."""
        units = metric_units(self.measured)
        return any(units.get(name) == "episodes" for name in self.paper.table1.metrics)

    @cached_property
    def lacking(self) -> dict[str, list[str]]:
        """By family of claims, what it needs and the study lacks."""
        return self.paper.lacking(self.study.variants_of, self.measured)

    @property
    def judged(self) -> bool:
        """Whether there is a ledger: for a study that has all that a family of claims is about."""
        return not all(self.lacking.values())

    @cached_property
    def pictures(self) -> list[str]:
        """Those that the study has the numbers for."""
        drawn: dict[str, Any] = {
            **dict.fromkeys((*FIGURES, "every_seed"), True),
            "constants": self.measured.constants,
            "solved": self.measured.solved_return,
            "forest": self.judged,
            "readings": self.read,
        }
        return [name for name, numbers in drawn.items() if numbers]

    @property
    def tabulated(self) -> list[str]:
        """The data of tables.md, by the names of their files."""
        # The last is seconds of reading that only Table 1 is worth.
        papers = ["readings"] if self.read and self.has_papers else []
        names = ["metrics", "betas", "table1", "supplement", "comparisons", "aggregate"]
        return [*names, *papers]

    # --- How it is shown ------------------------------------------------------------------------

    @property
    def style(self) -> dict[str, Any]:
        """The arguments of `plot_style` beside the measures."""
        study = self.study
        layout = study.figure.model_dump()
        return {"layout": layout, "labels": study.labels, "colours": study.colours}

    def ppo_settings(self) -> dict[str, dict[str, Any]]:
        """PPO's settings in each environment, and of the variants in it that have others."""
        found: dict[str, dict[str, Any]] = {}
        for env, variants in self.study.variants_of.items():
            own = {
                name: self.study.run_config(env, name, 0).ppo.model_dump()
                for name in variants
                if name in self.trained
            }
            if own:
                found[env] = next(iter(own.values()))
            for name, settings in own.items():
                if settings != found[env]:
                    found[f"{env}: {self.study.labels[name]}"] = settings
        return found

    def remarks(self, known: Mapping[str, Any]) -> list[str]:
        """What cannot be said of this study, in a line each; known: Gymnasium's registry."""
        study = self.study
        lines = study.metrics.incomplete(study.variants_of)
        budgets = sorted({episodes for *_, episodes in self.with_episodes})
        short = {tuple(out_of_reach(self.measured, episodes)): episodes for episodes in budgets}
        for names, episodes in short.items():
            if names:
                lines.append(f"{episodes} episodes are too few for {', '.join(names)}")
        for title, lacking in {} if self.judged else self.lacking.items():
            if not set(lacking).intersection(known):  # about environments that it has
                lines.append(
                    f"of {self.claims}, {title} are not judged: the study lacks {lacking[0]}"
                )
        seeds = [
            len(study.environment_seeds.get(env, study.seeds))
            for title, family in self.paper.families.items()
            if not self.lacking[title]
            for _, part in parts_of(family)
            for env in part.environments
        ]
        if seeds and (why := undecided(seeds)):
            lines.append(why)
        return lines
