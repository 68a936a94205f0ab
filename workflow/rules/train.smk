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
    priority: lambda wildcards: plan.priority(*run_of(wildcards))
    group:
        queue_entry
    threads: 1
    # A cluster that ends it for want of time or memory gives it more at the next attempt.
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
        runtime=lambda wildcards, attempt: minutes(wildcards) * attempt,
    params:
        config=lambda wildcards: run_config(wildcards).settings(),
        code=lambda wildcards: code("train.py", run_config(wildcards)),
        versions=lambda wildcards: provenance.versions(run_config(wildcards)),
    script:
        "../scripts/train.py"
