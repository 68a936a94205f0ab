# The study as the configuration describes it, checked, and what all rules share of it.

import mace_rl.base.cpu_features  # before NumPy: equal bits on every processor; the jobs inherit it
import json
import os
import shlex
import sys
from functools import reduce
from pathlib import Path

from mace_rl.base import files
from mace_rl.config.reading import merge, read_options, read_yaml
from mace_rl.config.section import ConfigError
from mace_study.config.study import load_study
from mace_rl.config.plugins import source_files
from mace_rl.environments import registered
from mace_study.plan import FIGURES, Plan, one_of
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
    plan = Plan(study, Path(workflow.basedir))
    plan.with_episodes
except ConfigError as error:
    sys.exit(f"Error in the configuration: {origin}: {error}")
except provenance.ProvenanceError as error:
    sys.exit(f"Error in the configuration: {origin}: {error}; mace-import makes it")

RESULTS = plan.results
RUN = f"{RESULTS}/runs/{{env}}/{{variant}}/seed{{seed}}"
FOLDERS = {files.folder_of(env): env for env in study.environments}
RECORDS = [f"{run}/{files.RECORD}" for run in plan.folders]
# Of the data of tables and pictures, what is measured on runs and not computed of that.
MEASURED = ("metrics", "betas", "readings", *FIGURES)


# How the study is carried out, for what tells where it comes from. Where its results are, and what
# they replace, is no part.
COMMAND = ["snakemake", "all", *(["--configfile", *config_files[1:]] if config_files[1:] else [])]
if changed := [option for option in options if not option.startswith(("results=", "replace="))]:
    COMMAND += ["--config", *changed]
COMMAND = shlex.join(COMMAND)


def shown(file, caption, category="Results"):
    """An output that Snakemake's own report shows."""
    return report(f"{RESULTS}/{file}", caption=f"../report/{caption}.rst", category=category)


wildcard_constraints:
    env=one_of(FOLDERS),
    variant=one_of(plan.trained),
    seed=one_of(dict.fromkeys(seed for _, _, seed in plan.runs)),


def run_of(wildcards):
    """Environment, variant and seed."""
    return FOLDERS[wildcards.env], wildcards.variant, int(wildcards.seed)


def run_config(wildcards):
    """All that determines a run besides the code."""
    return study.run_config(*run_of(wildcards))


def minutes(wildcards):
    """The time to ask a cluster for."""
    return slurm.minutes(run_config(wildcards), plan.work[run_of(wildcards)[:2]])


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
