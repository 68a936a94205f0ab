# What is measured on each run, one row per run.


rule metrics:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        metrics=f"{RESULTS}/metrics.csv",
        betas=f"{RESULTS}/betas.csv",
    log:
        f"{RESULTS}/logs/metrics.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        code=code("metrics.py", MEASURED),
    script:
        "../scripts/metrics.py"
