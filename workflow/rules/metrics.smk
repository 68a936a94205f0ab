# What is measured on each run, one row per run.


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
        code=code("metrics.py"),
    script:
        "../scripts/metrics.py"
