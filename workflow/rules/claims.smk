# The ledger, for a study that has all of the protocol's claims, or of its questions.


rule claims:
    input:
        metrics=f"{RESULTS}/metrics.csv",
        betas=f"{RESULTS}/betas.csv",
        records=RECORDS,
    output:
        json=f"{RESULTS}/claims.json",
        markdown=report(f"{RESULTS}/claims.md", caption="../report/claims.rst", category="Results"),
    log:
        f"{RESULTS}/logs/claims.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        command=COMMAND,
        code=code("claims.py", MEASURED),
    script:
        "../scripts/claims.py"
