# Figures over training, each drawn from its data alone: 1 is the paper's, 2 shows β.


rule curves:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        curves=report(
            f"{RESULTS}/figure{{number}}.csv", caption="../report/curves.rst", category="Results"
        ),
        single_seeds=f"{RESULTS}/figure{{number}}_seeds.csv",
    log:
        f"{RESULTS}/logs/curves{{number}}.log",
    wildcard_constraints:
        number="1|2",
    params:
        runs=TRAININGS,
        settings=study.metrics.model_dump(exclude={"custom"}),
        code=code("curves.py"),
    script:
        "../scripts/curves.py"


rule figure:
    input:
        curves=f"{RESULTS}/figure{{number}}.csv",
        single_seeds=f"{RESULTS}/figure{{number}}_seeds.csv",
    output:
        pdf=f"{RESULTS}/figure{{number}}.pdf",
        png=report(
            f"{RESULTS}/figure{{number}}.png", caption="../report/figure.rst", category="Results"
        ),
    log:
        f"{RESULTS}/logs/figure{{number}}.log",
    wildcard_constraints:
        number="1|2",
    params:
        layout=study.figure.model_dump(),
        settings=study.metrics.model_dump(exclude={"custom"}),
        labels=study.labels,
        colours=study.colours,
        code=code("figure.py"),
    script:
        "../scripts/figure.py"


rule pictures:
    input:
        f"{RESULTS}/metrics.csv",
    output:
        report(
            [f"{RESULTS}/{picture}.png" for picture in PICTURES],
            caption="../report/pictures.rst",
            category="Supplement",
        ),
        [f"{RESULTS}/{picture}.pdf" for picture in PICTURES],
        profiles=f"{RESULTS}/profiles.csv",
    log:
        f"{RESULTS}/logs/pictures.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        labels=study.labels,
        colours=study.colours,
        code=code("pictures.py", MEASURED),
    script:
        "../scripts/pictures.py"


if REGRET:

    localrules:
        regret_figure,

    rule regret_figure:
        input:
            f"{RESULTS}/metrics.csv",
        output:
            pdf=f"{RESULTS}/regret.pdf",
            png=report(
                f"{RESULTS}/regret.png", caption="../report/regret.rst", category="Supplement"
            ),
        log:
            f"{RESULTS}/logs/regret_figure.log",
        params:
            runs=TRAININGS,
            layout=study.figure.model_dump(),
            settings=MEASURED.model_dump(),
            labels=study.labels,
            colours=study.colours,
            code=code("regret_figure.py", MEASURED),
        script:
            "../scripts/regret_figure.py"


rule readings:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        table=f"{RESULTS}/readings.csv",
        markdown=report(
            f"{RESULTS}/readings.md", caption="../report/readings.rst", category="Supplement"
        ),
        png=report(
            f"{RESULTS}/readings.png", caption="../report/readings.rst", category="Supplement"
        ),
        pdf=f"{RESULTS}/readings.pdf",
    log:
        f"{RESULTS}/logs/readings.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        labels=study.labels,
        colours=study.colours,
        code=code("readings.py", MEASURED),
    script:
        "../scripts/readings.py"
