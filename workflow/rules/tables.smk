# The paper's tables, and whether their differences are more than chance.


rule table1:
    input:
        f"{RESULTS}/metrics.csv",
    output:
        table1=report(f"{RESULTS}/table1.tex", caption="../report/table1.rst", category="Results"),
        table1_data=report(
            f"{RESULTS}/table1.csv", caption="../report/table1.rst", category="Results"
        ),
        supplement=f"{RESULTS}/supplement.tex",
        supplement_data=report(
            f"{RESULTS}/supplement.csv", caption="../report/supplement.rst", category="Supplement"
        ),
    log:
        f"{RESULTS}/logs/table1.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        labels=study.labels,
        code=code("table1.py", MEASURED),
    script:
        "../scripts/table1.py"


rule comparisons:
    input:
        f"{RESULTS}/metrics.csv",
    output:
        **{
            name: report(
                f"{RESULTS}/{name}.csv", caption="../report/regret.rst", category="Supplement"
            )
            for name in REGRET
        },
        comparisons=report(
            f"{RESULTS}/comparisons.csv",
            caption="../report/comparisons.rst",
            category="Supplement",
        ),
    log:
        f"{RESULTS}/logs/comparisons.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        code=code("comparisons.py", MEASURED),
    script:
        "../scripts/comparisons.py"


rule table2:
    output:
        report(f"{RESULTS}/table2.tex", caption="../report/table2.rst", category="Methods"),
    log:
        f"{RESULTS}/logs/table2.log",
    params:
        ppo=ppo_settings(),
        code=code("table2.py"),
    script:
        "../scripts/table2.py"


rule aggregate:
    input:
        f"{RESULTS}/metrics.csv",
    output:
        report(f"{RESULTS}/aggregate.csv", caption="../report/aggregate.rst", category="Supplement"),
    log:
        f"{RESULTS}/logs/aggregate.log",
    params:
        runs=TRAININGS,
        settings=MEASURED.model_dump(),
        code=code("aggregate.py", MEASURED),
    script:
        "../scripts/aggregate.py"
