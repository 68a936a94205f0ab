# The study as the configuration describes it, checked, and what all rules share of it.

import mace_rl.base.cpu_features  # before NumPy: equal bits on every processor; the jobs inherit it
import json
import os
import re
import shlex
import sys
from functools import reduce
from pathlib import Path

from mace_rl.base import files
from mace_rl.config.reading import merge, read_options, read_yaml
from mace_rl.config.section import ConfigError
from mace_study.config.study import load_study
from mace_rl.config.plugins import code_outside, source_files
from mace_rl.environments import registered
from mace_study.compare.claims_config import FEWEST_SEEDS, read_claims, too_few
from mace_study.measure.metrics import all_metrics, out_of_reach
from mace_rl.runs import provenance, slurm
from mace_rl.runs.finished import in_the_way
from mace_rl.base.code_digest import digest

# Snakemake pastes this path into the shell commands of `script:` jobs, where a space would split it.
sys.executable = shlex.quote(sys.executable)

try:
    paths = [os.path.relpath(file) for file in workflow.configfiles]
    config_files = paths[-1:] + paths[:-1]  # Snakemake lists its own config.yaml last
    origin = " + ".join(config_files)
    # Files and options are read again: Snakemake makes 20241125 of `--config results=2024_11_25`.
    options = workflow.config_settings.config_args
    replaced = workflow.config_settings.replace_workflow_config  # then the first is left out
    layers = [*(read_yaml(Path(file)) for file in config_files[replaced:]), read_options(options)]
    study = load_study(reduce(merge, layers), origin)
except ConfigError as error:
    sys.exit(f"Error in the configuration: {error}")
try:
    MEASURED = study.metrics.within(study.environments, study.variants)
    all_metrics(MEASURED)  # the user's own among them: are they metrics?
    # Here, or else in the project: as where Snakemake is started in another folder.
    places = [Path(study.claims), Path(workflow.basedir, study.claims)]
    CLAIMS = os.path.relpath(next(filter(Path.exists, places), places[0]))
    paper = read_claims(study, CLAIMS)
except ConfigError as error:
    sys.exit(f"Error in the configuration: {origin}: {error}")

RESULTS = os.path.normpath(study.results)
RUN = f"{RESULTS}/runs/{{env}}/{{variant}}/seed{{seed}}"
RUNS = study.runs()
FOLDERS = {files.folder_of(env): env for env in study.environments}
MADE = [RUN.format(env=files.folder_of(env), variant=name, seed=seed) for env, name, seed in RUNS]
EPISODES, RECORDS = ([f"{run}/{file}" for run in MADE] for file in (files.EPISODES, files.RECORD))
HAS_PAPERS = paper.table1.is_within(study.environments, study.variants)
# What counts episodes can be read in several ways.
COUNTED = [metric.name for metric in all_metrics(MEASURED) if metric.unit == "episodes"]
READ = ["readings"] if set(COUNTED) & set(paper.table1.metrics) else []
# The ledger is for a study that has all that a family of claims is about.
LACKING = paper.lacking(study.environments, study.variants, MEASURED)
LEDGER = {} if all(LACKING.values()) else {"ledger": f"{RESULTS}/claims.json"}
FEWEST_OF_A_STUDY = min(
    len(study.environment_seeds.get(env, study.seeds)) for env in FOLDERS.values()
)
# Those that the configuration has the numbers for.
DRAWN = {"constants": MEASURED.constants, "solved": MEASURED.solved_return, "forest": LEDGER}
PICTURES = ["every_seed", *(picture for picture, numbers in DRAWN.items() if numbers)]
# By environment and variant, whatever the seed.
RUN_SETTINGS = {run[:2]: study.settings_of(*run[:2]) for run in RUNS}
TRAINED = study.trained()


def episodes_of(run, folder):
    """How many it has; imported runs have as many as they have."""
    own = RUN_SETTINGS[run[:2]].get("episodes")
    try:
        return own or provenance.read_record(Path(folder, files.RECORD))["config"]["episodes"]
    except provenance.ProvenanceError as error:
        sys.exit(f"Error in the configuration: {origin}: {error}; mace-import makes it")


TRAININGS = [(*run, episodes_of(run, folder)) for run, folder in zip(RUNS, MADE)]
RUNS_MEASURED = {"runs": TRAININGS, "settings": MEASURED.model_dump()}
STYLE = {"layout": study.figure.model_dump(), "labels": study.labels, "colours": study.colours}


def command(*words, options=options):
    """Snakemake's, for this study."""
    found = ["snakemake", *words]
    found += ["--configfile", *config_files[1:]] if config_files[1:] else []
    return shlex.join([*found, "--config", *options] if options else found)


# How the study is carried out, for what tells where it comes from. Where its results are is no part.
COMMAND = command("all", options=[one for one in options if not one.startswith("results=")])


def csv(*names):
    """Data of the study, by the names of their files."""
    return {name: f"{RESULTS}/{name}.csv" for name in names}


def shown(file, caption, category="Results"):
    """An output that Snakemake's own report shows."""
    return report(f"{RESULTS}/{file}", caption=f"../report/{caption}.rst", category=category)


def one_of(values):
    """A pattern that matches exactly these values, without any nothing."""
    return "|".join(re.escape(str(value)) for value in values) or "(?!)"


wildcard_constraints:
    env=one_of(FOLDERS),
    variant=one_of(TRAINED),
    seed=one_of({seed: None for _, _, seed in RUNS}),


def run_config(wildcards):
    """All that determines a run besides the code."""
    return study.run_config(FOLDERS[wildcards.env], wildcards.variant, int(wildcards.seed))


def ppo_settings():
    """PPO's settings in each environment, and of the variants in it that have others."""
    found = {}
    for env in study.environments if TRAINED else ():
        own = {name: study.run_config(env, name, 0).ppo.model_dump() for name in TRAINED}
        found[env] = own[TRAINED[0]]
        others = {name: settings for name, settings in own.items() if settings != found[env]}
        found |= {f"{env}: {study.labels[name]}": settings for name, settings in others.items()}
    return found


def own_code():
    """The settings of the runs whose agents are shown, where these name the user's own code."""
    trained = [run for run in reversed(RUNS) if run[1] in TRAINED]
    first = {run[:2]: study.run_config(*run) for run in trained}  # of its seeds
    shown = [config.settings() for config in first.values()]
    return [settings for settings in shown if code_outside(settings)]


def most_work(wildcards):
    """A measure of how long a run can take: long ones start first, and no core idles at the end."""
    config = run_config(wildcards)
    own_limit = registered()[config.environment.rpartition(":")[2]].max_episode_steps
    steps = config.episodes * (config.max_episode_steps or own_limit or 1000)
    return steps if config.beta.kind == "none" else 2 * steps


def minutes(wildcards):
    """The time to ask a cluster for."""
    return slurm.minutes(run_config(wildcards), most_work(wildcards))


def queue_entry(wildcards):
    """The group whose runs share entries of a cluster's queue; None without a cluster's profile."""
    return slurm.entry(minutes(wildcards), workflow.group_settings.group_components)


def code(script, settings=None):
    """Digest of a script, of mace_rl and of the user's code in `settings`, for a rule's `params:`.

    A change of code is thus a reason to run the job again. As an input it would not be: Snakemake
    goes by an input's time stamp first, and records what it contained when the job ended, so code
    that was edited meanwhile would pass for the code that ran.
    """
    part = "training" if script == "train.py" else "everything"
    scripts = [Path(workflow.basedir, "workflow", "scripts", name) for name in (script, "job.py")]
    named = settings.references() if settings else {}
    own = (file for key, name in named.items() for file in source_files(name, key))
    return digest(part, *scripts, *own)
