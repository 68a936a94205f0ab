# One job per environment, variant and seed.


rule train:
    output:
        episodes=f"{RUN}/{files.EPISODES}",
        diagnostics=f"{RUN}/{files.DIAGNOSTICS}",
        agent=f"{RUN}/{files.AGENT}",
        record=f"{RUN}/{files.RECORD}",
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
        config=lambda wildcards: run_config(wildcards).settings(),
        code=lambda wildcards: code("train.py", run_config(wildcards)),
        versions=provenance.versions(),
        arithmetic=arithmetic.chosen(),
    script:
        "../scripts/train.py"
