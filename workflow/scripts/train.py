"""One training run."""

import os
from pathlib import Path

from job import job

with job(snakemake):
    from mace_rl.config.run import RunConfig
    from mace_rl.runs.run import run

    run(
        RunConfig.model_validate(snakemake.params.config),
        Path(snakemake.output.episodes).parent,
        keep_checkpoint="MACE_RL_KEEP_CHECKPOINTS" in os.environ,
        aside="others",  # Snakemake knows that it is to be trained anew, and nobody is asked
    )
