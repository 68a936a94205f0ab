# One page of everything to read; Snakemake's own (`--report`) has the outputs one by one.

from mace_rl.base.code_digest import PACKAGE

PICTURED = ["figure1", "figure1_seeds", "figure2", "figure2_seeds", *READ]

# Of trainings: imported runs have no agents to show, no settings and no costs.
if TRAINED == study.variants:

    # The agents that are shown are no inputs: where runs are kept without them, the page says so. Each
    # run.json, which is an input, has its agent's digest.
    rule page:
        input:
            **csv(*TABULATED, *PICTURED),
            **LEDGER,
            claims=CLAIMS,
            records=RECORDS,
            # To these the page refers.
            in_print=[f"{RESULTS}/{name}" for name in ("figure1.pdf", "figure2.pdf", "table2.tex")],
        output:
            f"{RESULTS}/report.html",
        log:
            f"{RESULTS}/logs/report.log",
        localrule: True
        params:
            **RUNS_MEASURED,
            style=STYLE | {"layout": {"columns": 3}},
            command=COMMAND,
            configuration={
                file: Path(file).read_text(encoding="utf-8") for file in (*config_files, CLAIMS)
            },
            ppo=ppo_settings(),
            own=own_code(),
            template=provenance.file_digest(PACKAGE.parent / "mace_study" / "show" / "report.html"),
            code=code("page.py", MEASURED),
        script:
            "../scripts/page.py"
