"""Table 2: the hyperparameters."""

from job import job

with job("Table 2", snakemake.log[0]):
    from mace_rl.config.agent import PPOConfig
    from mace_rl.files import write_atomically
    from mace_rl.study.show.latex import table2_latex

    ppo = {env: PPOConfig.model_validate(values) for env, values in snakemake.params.ppo.items()}
    write_atomically(snakemake.output[0], table2_latex(ppo))
