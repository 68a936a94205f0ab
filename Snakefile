"""From the configuration to Table 1 and Figure 1: train, measure, tabulate, draw.

    snakemake -j2 all                                      the paper's budgets (hours)
    snakemake -j2 all --configfile config/reduced.yaml     the same at small budgets (minutes)
    snakemake -j2 page                                     all of it on one page

Defaults of the command line are in profiles/default/config.yaml.
"""


configfile: "config.yaml"


include: "workflow/rules/study.smk"


# On a cluster these are not worth a place in the queue: seconds of work each.
localrules:
    all,
    metrics,
    claims,
    tables,
    table2,
    tables_page,
    figure,
    picture,
    readings,
    page,


rule all:
    input:
        f"{RESULTS}/metrics.csv",
        f"{RESULTS}/betas.csv",
        f"{RESULTS}/tables.md",
        f"{RESULTS}/table1.tex",
        f"{RESULTS}/table1.csv",
        f"{RESULTS}/supplement.csv",
        f"{RESULTS}/comparisons.csv",
        f"{RESULTS}/aggregate.csv",
        f"{RESULTS}/table2.tex",
        f"{RESULTS}/figure1.pdf",
        f"{RESULTS}/figure1.png",
        f"{RESULTS}/figure1.csv",
        f"{RESULTS}/figure2.pdf",
        f"{RESULTS}/figure2.png",
        f"{RESULTS}/figure2.csv",
        *[f"{RESULTS}/{name}.csv" for name in REGRET],
        *[f"{RESULTS}/{name}.{kind}" for name in PICTURES for kind in ("csv", "pdf", "png")],
        f"{RESULTS}/readings.csv",
        f"{RESULTS}/readings.pdf",
        f"{RESULTS}/readings.png",
        *CLAIMS,


include: "workflow/rules/train.smk"
include: "workflow/rules/metrics.smk"
include: "workflow/rules/tables.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/claims.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/terminal.smk"
