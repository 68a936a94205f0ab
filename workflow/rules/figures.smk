# Pictures, each with its data beside it as CSV.


# Over training: 1 is the paper's, 2 shows β.
rule figure:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        curves=shown("figure{number}.csv", "figure"),
        single_seeds=f"{RESULTS}/figure{{number}}_seeds.csv",
        pdf=f"{RESULTS}/figure{{number}}.pdf",
        png=shown("figure{number}.png", "figure"),
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


# Of all runs at once, or of the ledger: `PICTURES` of mace_study.show.pictures.
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
        png=shown("{picture}.png", "picture"),
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


rule readings:
    input:
        records=RECORDS,
        episodes=EPISODES,
        claims=CLAIMS,
    output:
        data=f"{RESULTS}/readings.csv",
        pdf=f"{RESULTS}/readings.pdf",
        png=shown("readings.png", "picture", "Supplement"),
    log:
        f"{RESULTS}/logs/readings.log",
    params:
        **RUNS_MEASURED,
        style=STYLE,
        code=code("readings.py", MEASURED),
    script:
        "../scripts/readings.py"
