"""The ledger: what of the paper holds, and what of our own questions (docs/protocol.md)."""

from job import job

with job("claims", snakemake.log[0]):
    import json
    from pathlib import Path

    from mace_rl.files import write_atomically
    from mace_rl.runs.provenance import read_record
    from mace_rl.runs.records import read_table
    from mace_rl.study.claims_config import asked
    from mace_rl.study.compare.verdicts import ledger
    from mace_rl.study.measure.run_metrics import BETAS, read_metrics
    from mace_rl.study.metrics_config import MetricsConfig
    from mace_rl.study.show.markdown import claims_page

    params, found, output = snakemake.params, snakemake.input, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    table = read_metrics(found.metrics, params.runs, settings)
    table = table.merge(read_table(found.betas, BETAS), how="left", validate="1:1")
    claims = ledger(table, settings, asked(table["env"], table["variant"]))
    hours = sum(read_record(Path(path))["seconds"] for path in found.records) / 3600
    cost = {"command": params.command, "runs": len(table), "core_hours": hours}
    whole = {"cost": cost, "claims": claims}
    text = json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False)
    write_atomically(output.json, text + "\n")
    origin = f"`{params.command}`: {len(table)} runs, {hours:.1f} core-hours."
    write_atomically(output.markdown, claims_page(claims, origin))
