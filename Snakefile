"""From the configuration to Table 1 and Figure 1: train, measure, tabulate, draw.

    snakemake -j2 all                                      the paper's budgets (hours)
    snakemake -j2 all --configfile config/reduced.yaml     the same at small budgets (minutes)

Defaults of the command line are in profiles/default/config.yaml.
"""


configfile: f"{workflow.basedir}/config.yaml"


include: "workflow/rules/study.smk"
include: "workflow/rules/train.smk"
include: "workflow/rules/results.smk"
include: "workflow/rules/terminal.smk"


# On a cluster these are not worth a place in the queue: seconds of work each.
localrules:
    all,
    metrics,
    tables,
    pictures,


rule all:
    default_target: True
    input:
        rules.metrics.output,
        rules.tables.output,
        rules.pictures.output,
