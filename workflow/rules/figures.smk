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
        layout=study.figure.model_dump(),
        settings=study.metrics.model_dump(exclude={"custom"}),
        labels=study.labels,
        colours=study.colours,
        code=code("figure.py"),
    script:
        "../scripts/figure.py"


# Of all runs at once: `PICTURES` of mace_rl.study.show.pictures, the forest plot of the claims below.
rule picture:
    input:
        f"{RESULTS}/metrics.csv",
    output:
        data=f"{RESULTS}/{{picture}}.csv",
        pdf=f"{RESULTS}/{{picture}}.pdf",
        png=report(
            f"{RESULTS}/{{picture}}.png", caption="../report/picture.rst", category="Results"
        ),
    log:
        f"{RESULTS}/logs/{{picture}}.log",
    wildcard_constraints:
        picture="every_seed|constants|solved",
    params:
        runs=TRAININGS,
        layout=study.figure.model_dump(),
        settings=MEASURED.model_dump(),
        labels=study.labels,
        colours=study.colours,
        code=code("picture.py", MEASURED),
    script:
        "../scripts/picture.py"


if CLAIMS:

    localrules:
        forest,

    use rule picture as forest with:
        input:
            CLAIMS[0],
        wildcard_constraints:
            picture="forest",


rule readings:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        table=f"{RESULTS}/readings.csv",
        png=report(
            f"{RESULTS}/readings.png", caption="../report/readings.rst", category="Supplement"
        ),
        pdf=f"{RESULTS}/readings.pdf",
    log:
        f"{RESULTS}/logs/readings.log",
    params:
        runs=TRAININGS,
        layout=study.figure.model_dump(),
        settings=MEASURED.model_dump(),
        labels=study.labels,
        colours=study.colours,
        code=code("readings.py", MEASURED),
    script:
        "../scripts/readings.py"
