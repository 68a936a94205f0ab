# Pictures, each with its data beside it as CSV.


# Over training: 1 is the paper's, 2 shows β.
FIGURES = ["figure1", "figure2"]


# In one job, since reading the runs takes as long as drawing them.
rule figures:
    input:
        episodes=EPISODES,
        records=RECORDS,
    output:
        curves=[shown(f"{figure}.csv", figure) for figure in FIGURES],
        single_seeds=[f"{RESULTS}/{figure}_seeds.csv" for figure in FIGURES],
        pdf=[f"{RESULTS}/{figure}.pdf" for figure in FIGURES],
        png=[shown(f"{figure}.png", figure) for figure in FIGURES],
    log:
        f"{RESULTS}/logs/figures.log",
    params:
        runs=TRAININGS,
        run_settings=RUN_SETTINGS,
        settings=study.metrics.model_dump(exclude={"custom"}),
        style=STYLE,
        code=code("figures.py"),
    script:
        "../scripts/figures.py"


# Of all runs at once, or of the ledger: `PICTURES` of mace_study.show.pictures.
rule picture:
    input:
        unpack(
            lambda wildcards: (
                LEDGER if wildcards.picture == "forest" else {"metrics": f"{RESULTS}/metrics.csv"}
            )
        ),
        claims=CLAIMS,
    output:
        data=f"{RESULTS}/{{picture}}.csv",
        pdf=f"{RESULTS}/{{picture}}.pdf",
        png=shown("{picture}.png", "picture"),
    log:
        f"{RESULTS}/logs/{{picture}}.log",
    wildcard_constraints:
        picture="every_seed|constants|solved|forest",
    params:
        **RUNS_MEASURED,
        style=STYLE,
        code=code("picture.py", MEASURED),
    script:
        "../scripts/picture.py"


rule readings:
    input:
        records=RECORDS,
        episodes=EPISODES,
        claims=CLAIMS,
    output:
        data=f"{RESULTS}/readings.csv",
        pdf=f"{RESULTS}/readings.pdf",
        png=shown("readings.png", "picture", "Supplement"),
    log:
        f"{RESULTS}/logs/readings.log",
    params:
        **RUNS_MEASURED,
        run_settings=RUN_SETTINGS,
        style=STYLE,
        code=code("readings.py", MEASURED),
    script:
        "../scripts/readings.py"
