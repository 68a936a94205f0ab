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
        code=code("metrics.py", MEASURED),
    script:
        "../scripts/metrics.py"


SUPPLEMENT = {
    name: report(f"{RESULTS}/{name}.csv", caption=f"../report/{name}.rst", category="Supplement")
    for name in ("supplement", "comparisons", "aggregate")
}


rule tables:
    input:
        metrics=f"{RESULTS}/metrics.csv",
        claims=CLAIMS,
    output:
        **SUPPLEMENT,
        table1=report(f"{RESULTS}/table1.csv", caption="../report/table1.rst", category="Results"),
        table1_tex=report(
            f"{RESULTS}/table1.tex", caption="../report/table1.rst", category="Results"
        ),
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
        report(f"{RESULTS}/table2.tex", caption="../report/table2.rst", category="Methods"),
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
        report(f"{RESULTS}/tables.md", caption="../report/tables.rst", category="Results"),
    log:
        f"{RESULTS}/logs/tables_page.log",
    params:
        **RUNS_MEASURED,
        pictures=["figure1", "figure2", *PICTURES, *READ],
        command=COMMAND,
        code=code("tables_page.py", MEASURED),
    script:
        "../scripts/tables_page.py"
