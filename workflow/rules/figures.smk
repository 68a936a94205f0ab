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
        code=code("evaluate.py"),
    script:
        "../scripts/evaluate.py"


# Of all runs at once: `PICTURES` of mace_rl.study.show.pictures, those of other data below.
rule picture:
    input:
        metrics=f"{RESULTS}/metrics.csv",
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
        picture="every_seed|constants|solved",
    params:
        runs=TRAININGS,
        layout=study.figure.model_dump(),
        settings=MEASURED.model_dump(),
        labels=study.labels,
        colours=study.colours,
        code=code("evaluate.py", MEASURED),
    script:
        "../scripts/evaluate.py"


if LEDGER:

    localrules:
        forest,

    use rule picture as forest with:
        input:
            **LEDGER,
            claims=CLAIMS,
        wildcard_constraints:
            picture="forest",


if READ:

    localrules:
        readings,

    use rule picture as readings with:
        input:
            episodes=EPISODES,
            records=RECORDS,
            claims=CLAIMS,
        output:  # the PNG first: a figure that is laid out once more is a little different
            data=f"{RESULTS}/{{picture}}.csv",
            png=report(
                f"{RESULTS}/{{picture}}.png",
                caption="../report/picture.rst",
                category="Supplement",
            ),
            pdf=f"{RESULTS}/{{picture}}.pdf",
        wildcard_constraints:
            picture="readings",
