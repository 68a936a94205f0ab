# What is measured on each run, one row per run.

from mace_rl.results.metrics import all_metrics

try:
    MEASURED = study.metrics.within(study.environments, study.variants)
    all_metrics(MEASURED)  # the user's own among them: are they metrics?
except ConfigError as error:
    sys.exit(f"Error in the configuration: {origin}: {error}")


rule metrics:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        f"{RESULTS}/metrics.csv",
    log:
        f"{RESULTS}/logs/metrics.log",
    params:
        runs=BUDGETS,
        settings=MEASURED.model_dump(),
        code=code("metrics.py", MEASURED),
    script:
        "../scripts/metrics.py"
