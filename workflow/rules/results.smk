# What is made of the runs: one rule each for what reads them all, for tables, and for pictures.


# In one job, since reading the runs takes as long as measuring them.
rule metrics:
    input:
        episodes=[f"{run}/{files.EPISODES}" for run in plan.folders],
        records=RECORDS,
        claims=plan.claims,
    output:
        metrics=f"{RESULTS}/metrics.csv",
        betas=f"{RESULTS}/betas.csv",
        curves=[shown(f"{figure}.csv", figure) for figure in FIGURES],
        single_seeds=[f"{RESULTS}/{figure}_seeds.csv" for figure in FIGURES],
        readings=[f"{RESULTS}/readings.csv"] if plan.read else [],
    log:
        f"{RESULTS}/logs/metrics.log",
    params:
        runs=plan.with_episodes,
        settings=plan.measured.model_dump(),
        run_settings=plan.run_settings,
        figures=FIGURES,
        read=plan.read,
        code=code("metrics.py", plan.measured),
    script:
        "../scripts/metrics.py"


# The pictures are no inputs: the page only names them.
rule tables:
    input:
        data=[f"{RESULTS}/{name}.csv" for name in plan.tabulated if name in MEASURED],
        records=RECORDS if plan.judged else [],
        claims=plan.claims,
    output:
        supplement=shown("supplement.csv", "supplement", "Supplement"),
        comparisons=shown("comparisons.csv", "comparisons", "Supplement"),
        aggregate=shown("aggregate.csv", "aggregate", "Supplement"),
        table1=shown("table1.csv", "table1"),
        table1_tex=shown("table1.tex", "table1"),
        table2=[shown("table2.tex", "table2", "Methods")] if plan.trained else [],
        json=[f"{RESULTS}/claims.json"] if plan.judged else [],
        markdown=[shown("claims.md", "claims")] if plan.judged else [],
        page=shown("tables.md", "tables"),
    log:
        f"{RESULTS}/logs/tables.log",
    params:
        runs=plan.with_episodes,
        settings=plan.measured.model_dump(),
        labels=study.labels,
        ppo=plan.ppo_settings(),
        judged=plan.judged,
        tabulated=plan.tabulated,
        pictures=plan.pictures,
        command=COMMAND,
        code=code("tables.py", plan.measured),
    script:
        "../scripts/tables.py"


rule pictures:
    input:
        metrics=f"{RESULTS}/metrics.csv",
        data=[*rules.metrics.output.curves, *rules.metrics.output.single_seeds],
        readings=rules.metrics.output.readings,
        ledger=rules.tables.output.json,
        claims=plan.claims,
    output:
        data=[f"{RESULTS}/{name}.csv" for name in plan.pictures if name not in MEASURED],
        pdf=[f"{RESULTS}/{name}.pdf" for name in plan.pictures],
        png=[shown(f"{name}.png", name) for name in plan.pictures],
    log:
        f"{RESULTS}/logs/pictures.log",
    params:
        names=plan.pictures,
        runs=plan.with_episodes,
        settings=plan.measured.model_dump(),
        style=plan.style,
        judged=plan.judged,
        code=code("pictures.py", plan.measured),
    script:
        "../scripts/pictures.py"
