"""Table 2: the hyperparameters."""

from job import job

from mace_rl.base.files import write_atomically
from mace_rl.config.agent import PPOConfig
from mace_study.compare.claims_config import parse_claims
from mace_study.show.latex import table2_latex

with job(snakemake):
    paper = parse_claims(snakemake.input.claims).table2
    ppo = {env: PPOConfig.model_validate(own) for env, own in snakemake.params.ppo.items()}
    write_atomically(snakemake.output[0], table2_latex(ppo, paper))
