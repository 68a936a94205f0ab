"""The claim ledger: what of the paper holds, by the rule in docs/method.md."""

from job import job

with job("claims", snakemake.log[0]):
    from pathlib import Path

    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results import claims, claims_text
    from mace_rl.results.metrics_table import read_metrics
    from mace_rl.results.paper import FULL
    from mace_rl.runs.finished import read_runs
    from mace_rl.runs.provenance import read_record

    params = snakemake.params
    settings = MetricsConfig.model_validate(params.settings)
    table = read_metrics(snakemake.input.metrics, [tuple(run[:3]) for run in params.runs], settings)
    records = snakemake.input.records
    full = [(path, run) for path, run in zip(records, params.runs, strict=True) if run[1] == FULL]
    correlations = {
        run: claims.stagnation_correlation(
            frame["extrinsic_return"].to_numpy(), frame["beta"].to_numpy(), settings.moving_average
        )
        for run, frame in read_runs(*zip(*full, strict=True)).items()
    }
    runs = zip(table["env"], table["variant"], table["seed"], strict=True)
    table[claims.CORRELATION] = [correlations.get(run, float("nan")) for run in runs]
    ledger = claims.ledger(table, settings)
    seconds = sum(read_record(Path(path))["seconds"] for path in records)
    cost = {"command": params.command, "runs": len(table), "core_hours": seconds / 3600}
    write_atomically(snakemake.output.json, claims_text.as_json(ledger, cost))
    origin = f"`{cost['command']}`: {cost['runs']} runs, {cost['core_hours']:.1f} core-hours."
    write_atomically(snakemake.output.markdown, claims_text.markdown(ledger, origin))
