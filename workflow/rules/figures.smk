# Figures over training, each drawn from its data alone: 1 is the paper's, 2 shows β.


rule curves:
    input:
        EPISODES,
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
        runs=BUDGETS,
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
