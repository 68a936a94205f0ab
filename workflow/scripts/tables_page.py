"""tables.md: every table of the study on one page, for reading beside its pictures."""

from job import job

with job("the page of tables", snakemake.log[0]):
    import json
    from pathlib import Path

    import pandas as pd

    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results.metrics_table import BETAS, read_metrics
    from mace_rl.results.pages import tables_page
    from mace_rl.results.records import read_table

    params, found = snakemake.params, dict(snakemake.input.items())
    settings = MetricsConfig.model_validate(params.settings)
    claims = found.pop("claims", None)
    data = {name: pd.read_csv(path) for name, path in found.items()}
    data["metrics"] = read_metrics(found["metrics"], params.runs, settings)
    data["betas"] = read_table(found["betas"], BETAS)
    ledger = json.loads(Path(claims).read_text(encoding="utf-8"))["claims"] if claims else None
    origin = f"`{params.command}`: {len(params.runs)} runs."
    page = tables_page(data, ledger, params.pictures, settings, origin)
    write_atomically(snakemake.output[0], page)
