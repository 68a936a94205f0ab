# Pictures, each with its data beside it as CSV.


# Over training: 1 is the paper's, 2 shows β.
rule figure:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        curves=report(
            f"{RESULTS}/figure{{number}}.csv", caption="../report/figure.rst", category="Results"
        ),
        single_seeds=f"{RESULTS}/figure{{number}}_seeds.csv",
        pdf=f"{RESULTS}/figure{{number}}.pdf",
        png=report(
            f"{RESULTS}/figure{{number}}.png", caption="../report/figure.rst", category="Results"
        ),
    log:
        f"{RESULTS}/logs/figure{{number}}.log",
    wildcard_constraints:
        number="1|2",
    params:
        runs=TRAININGS,
        settings=study.metrics.model_dump(exclude={"custom"}),
        style=STYLE,
        code=code("figure.py"),
    script:
        "../scripts/figure.py"


# Of all runs at once, or of the ledger: `PICTURES` of mace_rl.study.show.pictures.
rule picture:
    input:
        unpack(
            lambda wildcards: (
                LEDGER if wildcards.picture == "forest" else {"metrics": f"{RESULTS}/metrics.csv"}
            )
        ),
        claims=CLAIMS,
    output:
        data=f"{RESULTS}/{{picture}}.csv",
        pdf=f"{RESULTS}/{{picture}}.pdf",
        png=report(
            f"{RESULTS}/{{picture}}.png", caption="../report/picture.rst", category="Results"
        ),
    log:
        f"{RESULTS}/logs/{{picture}}.log",
    wildcard_constraints:
        picture="every_seed|constants|solved|forest",
    params:
        **RUNS_MEASURED,
        style=STYLE,
        code=code("picture.py", MEASURED),
    script:
        "../scripts/picture.py"


# Seconds of work that only Table 1 is worth.
rule readings:
    input:
        records=RECORDS,
        episodes=EPISODES,
        claims=CLAIMS,
    output:
        data=f"{RESULTS}/readings.csv",
        pdf=f"{RESULTS}/readings.pdf",
        png=report(
            f"{RESULTS}/readings.png", caption="../report/picture.rst", category="Supplement"
        ),
    log:
        f"{RESULTS}/logs/readings.log",
    params:
        **RUNS_MEASURED,
        style=STYLE,
        code=code("readings.py", MEASURED),
    script:
        "../scripts/readings.py"
