# The paper's figure, drawn from its data alone.


rule curves:
    input:
        EPISODES,
    output:
        curves=report(
            f"{RESULTS}/figure1.csv", caption="../report/figure1_data.rst", category="Results"
        ),
        single_seeds=f"{RESULTS}/figure1_seeds.csv",
    log:
        f"{RESULTS}/logs/curves.log",
    params:
        runs=BUDGETS,
        settings=study.metrics.model_dump(),
        code=code("curves.py"),
    script:
        "../scripts/curves.py"


rule figure1:
    input:
        curves=f"{RESULTS}/figure1.csv",
        single_seeds=f"{RESULTS}/figure1_seeds.csv",
    output:
        pdf=f"{RESULTS}/figure1.pdf",
        png=report(f"{RESULTS}/figure1.png", caption="../report/figure1.rst", category="Results"),
    log:
        f"{RESULTS}/logs/figure1.log",
    params:
        layout=study.figure.model_dump(),
        settings=study.metrics.model_dump(),
        labels=selected(study.labels),
        colours=selected(study.colours),
        code=code("figure1.py"),
    script:
        "../scripts/figure1.py"
