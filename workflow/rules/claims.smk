# The claim ledger, for a study that has all the paper makes claims of.


rule claims:
    input:
        metrics=f"{RESULTS}/metrics.csv",
        episodes=EPISODES,
        records=[path.replace(files.EPISODES, files.RECORD) for path in EPISODES],
    output:
        json=f"{RESULTS}/claims.json",
        markdown=report(f"{RESULTS}/claims.md", caption="../report/claims.rst", category="Results"),
    log:
        f"{RESULTS}/logs/claims.log",
    params:
        runs=BUDGETS,
        settings=MEASURED.model_dump(),
        command="snakemake all"
        + (f" --configfile {' '.join(paths[:-1])}" if len(paths) > 1 else ""),
        code=code("claims.py", MEASURED),
    script:
        "../scripts/claims.py"
