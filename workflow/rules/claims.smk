# The ledger, for a study that has all that a family of claims is about.


rule claims:
    input:
        metrics=f"{RESULTS}/metrics.csv",
        betas=f"{RESULTS}/betas.csv",
        records=RECORDS,
        claims=CLAIMS,
    output:
        json=f"{RESULTS}/claims.json",
        markdown=shown("claims.md", "claims"),
    log:
        f"{RESULTS}/logs/claims.log",
    params:
        **RUNS_MEASURED,
        command=COMMAND,
        code=code("claims.py", MEASURED),
    script:
        "../scripts/claims.py"
