# What is measured on each run, one row per run.


rule metrics:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        f"{RESULTS}/metrics.csv",
    log:
        f"{RESULTS}/logs/metrics.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        code=code("metrics.py", MEASURED),
    script:
        "../scripts/metrics.py"
