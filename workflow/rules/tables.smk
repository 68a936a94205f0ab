# What is measured on each run; the paper's tables, whether their differences are more than chance,
# and all of it on one page.


rule metrics:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        metrics=f"{RESULTS}/metrics.csv",
        betas=f"{RESULTS}/betas.csv",
    log:
        f"{RESULTS}/logs/metrics.log",
    params:
        **RUNS_MEASURED,
        run_settings=RUN_SETTINGS,
        code=code("metrics.py", MEASURED),
    script:
        "../scripts/metrics.py"


rule tables:
    input:
        metrics=f"{RESULTS}/metrics.csv",
        claims=CLAIMS,
    output:
        supplement=shown("supplement.csv", "supplement", "Supplement"),
        comparisons=shown("comparisons.csv", "comparisons", "Supplement"),
        aggregate=shown("aggregate.csv", "aggregate", "Supplement"),
        table1=shown("table1.csv", "table1"),
        table1_tex=shown("table1.tex", "table1"),
    log:
        f"{RESULTS}/logs/tables.log",
    params:
        **RUNS_MEASURED,
        labels=study.labels,
        code=code("tables.py", MEASURED),
    script:
        "../scripts/tables.py"


rule table2:
    input:
        claims=CLAIMS,
    output:
        shown("table2.tex", "table2", "Methods"),
    log:
        f"{RESULTS}/logs/table2.log",
    params:
        ppo=ppo_settings(),
        code=code("table2.py"),
    script:
        "../scripts/table2.py"


TABULATED = ["metrics", "betas", "table1", "supplement", "comparisons", "aggregate"]
TABULATED += READ if HAS_PAPERS else []  # seconds of work that only Table 1 is worth


# The pictures are no inputs: the page only names them.
rule tables_page:
    input:
        **csv(*TABULATED),
        **LEDGER,
        claims=CLAIMS,
    output:
        shown("tables.md", "tables"),
    log:
        f"{RESULTS}/logs/tables_page.log",
    params:
        **RUNS_MEASURED,
        pictures=["figure1", "figure2", *PICTURES, *READ],
        command=COMMAND,
        code=code("tables_page.py", MEASURED),
    script:
        "../scripts/tables_page.py"
