"""From the configuration to Table 1 and Figure 1: train, measure, tabulate, draw.

    snakemake -j2 all                                      the paper's budgets (hours)
    snakemake -j2 all --configfile config/reduced.yaml     the same at small budgets (minutes)
    snakemake -j2 page                                     all of it on one page

Defaults of the command line are in profiles/default/config.yaml.
"""


configfile: f"{workflow.basedir}/config.yaml"


include: "workflow/rules/study.smk"
include: "workflow/rules/train.smk"
include: "workflow/rules/tables.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/claims.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/terminal.smk"


# On a cluster these are not worth a place in the queue: seconds of work each.
localrules:
    all,
    metrics,
    claims,
    tables,
    table2,
    tables_page,
    figures,
    picture,
    readings,


rule all:
    default_target: True
    input:
        rules.metrics.output,
        rules.tables.output,
        rules.table2.output if TRAINED else [],
        rules.tables_page.output,
        rules.figures.output,
        expand(rules.picture.output, picture=PICTURES),
        rules.readings.output if READ else [],
        rules.claims.output if LEDGER else [],
