# One job per environment, variant and seed.


rule train:
    output:
        episodes=f"{RUN}/episodes.csv",
        record=f"{RUN}/run.json",
        agent=f"{RUN}/agent.pt",
    log:
        f"{RESULTS}/logs/train/{{env}}/{{variant}}/seed{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/train/{{env}}/{{variant}}/seed{{seed}}.tsv"
    priority: most_work
    threads: 1
    resources:
        mem_mb=1000,
        runtime=1440,
    params:
        config=lambda wildcards: run_config(wildcards).model_dump(),
        code=code("train.py"),
        versions=provenance.versions(),
    script:
        "../scripts/train.py"
