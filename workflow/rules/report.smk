# One page of everything to read; Snakemake's own (`--report`) has the outputs one by one.

from mace_rl.base.code_digest import PACKAGE

# Of trainings: imported runs have no agents to show, no settings and no costs.
if plan.trained == study.variants:

    # The agents that are shown are no inputs: where runs are kept without them, the page says so. Each
    # run.json, which is an input, has its agent's digest.
    rule page:
        input:
            data=[f"{RESULTS}/{name}.csv" for name in plan.paged],
            ledger=rules.tables.output.json,
            claims=plan.claims,
            records=RECORDS,
            # To these the page refers.
            in_print=[f"{RESULTS}/{name}" for name in ("figure1.pdf", "figure2.pdf", "table2.tex")],
        output:
            f"{RESULTS}/report.html",
        log:
            f"{RESULTS}/logs/report.log",
        localrule: True
        params:
            runs=plan.with_episodes,
            settings=plan.measured.model_dump(),
            style=plan.style | {"layout": {"columns": 3}},
            command=COMMAND,
            configuration={
                file: Path(file).read_text(encoding="utf-8")
                for file in (*config_files, plan.claims)
            },
            ppo=plan.ppo_settings(),
            own=plan.own_code(),
            paged=plan.paged,
            judged=plan.judged,
            template=provenance.file_digest(PACKAGE.parent / "mace_study" / "show" / "report.html"),
            code=code("page.py", plan.measured),
        script:
            "../scripts/page.py"
