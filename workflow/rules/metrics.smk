# What is measured on each run, one row per run.

from mace_rl.results.metrics import all_metrics

try:
    all_metrics(study.metrics)  # the user's own among them: are they metrics?
except ConfigError as error:
    sys.exit(f"Error in the configuration: {origin}: {error}")


rule metrics:
    input:
        EPISODES,
    output:
        f"{RESULTS}/metrics.csv",
    log:
        f"{RESULTS}/logs/metrics.log",
    params:
        runs=BUDGETS,
        environments=study.environments,
        variants=study.variants,
        seeds=study.seeds,
        settings=study.metrics.model_dump(),
        code=code("metrics.py", study.metrics),
    script:
        "../scripts/metrics.py"
