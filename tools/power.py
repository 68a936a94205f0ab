"""What 20 seeds can show, simulated from the spread of the first study: for docs/protocol.md.

    .venv/bin/python -m tools.power [SEEDS]

The paired differences of each part are those of the first study, less their mean, plus a difference
that is supposed to be true, in margins; 2000 studies of SEEDS seeds are drawn from them with
replacement, and judged by the protocol's rule (with Student's t for the sign-flip test, which is as
good here and quick). A task that is new has the differences of BarrenRegion-v0.
"""

import io
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from mace_rl.config.results import MetricsConfig
from mace_rl.config.study import read_study
from mace_rl.results.claims import LEVEL, WORTH_MENTIONING, _everything, _pair
from mace_rl.results.metrics import all_metrics, stagnation_correlation
from mace_rl.results.paper import ENVIRONMENTS, FULL
from mace_rl.results.protocol import CORRELATION, DISTRACTING, FAMILIES, ROBUST, Family, Part
from tools import kept_runs

STUDIES = 2000
TRUTHS = {"0": 0.0, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0, "as seen": None}  # in margins


def first_study(window: int) -> pd.DataFrame:
    """All runs of it by environment, variant and seed."""
    tables = [pd.read_csv(path) for path in sorted(Path("reference/tables").glob("*/metrics.csv"))]
    keys = ["env", "variant", "seed"]
    table = pd.concat(tables).groupby(keys, as_index=False).first()
    found = {}
    for env in ENVIRONMENTS:
        content = kept_runs.read(Path(f"reference/study/{env}/{FULL}.tar.xz"))
        for name in content:
            if name.endswith("episodes.csv"):
                run = pd.read_csv(io.BytesIO(content[name]))
                values = run["extrinsic_return"].to_numpy(), run["beta"].to_numpy()
                seed = int(name.removeprefix("seed").partition("/")[0])
                found[env, FULL, seed] = stagnation_correlation(*values, window)
    table[CORRELATION] = [found.get(key) for key in table[keys].itertuples(index=False, name=None)]
    barren = table[table["env"] == DISTRACTING[0]]
    return pd.concat([table, *(barren.assign(env=env) for env in DISTRACTING[1:])])


def holm(p: np.ndarray) -> np.ndarray:
    """Of each row of [studies, parts]."""
    order = np.argsort(p, axis=1)
    factors = np.arange(p.shape[1], 0, -1)
    ordered = np.maximum.accumulate(np.take_along_axis(p, order, 1) * factors, axis=1)
    adjusted = np.empty_like(p)
    np.put_along_axis(adjusted, order, np.minimum(ordered, 1), 1)
    return adjusted


def shares(
    family: Family, table: pd.DataFrame, settings: MetricsConfig, seeds: int
) -> pd.DataFrame:
    """For each part and truth, in how many studies it comes out shown, absent, reversed."""
    rng = np.random.default_rng(0)
    metrics = {metric.name: metric for metric in all_metrics(settings)}
    parts = [(claim.name, part) for claim in family.claims for part in claim.parts[ROBUST]]

    def strata(part: Part) -> list[np.ndarray]:
        """Differences by environment, as shares of everything."""
        both = table[table["variant"].isin([part.variant, part.baseline])]
        found = []
        for env in part.environments:
            runs = both[both["env"] == env]
            x, y = _pair(part, runs, metrics)
            known = ~np.isnan(x - y)
            scale = _everything(part, runs, env, metrics, settings)
            found.append((x - y)[known] / scale)
        return found

    differences = [strata(part) for _, part in parts]
    environments = {env for _, part in parts for env in part.environments}
    drawn = {env: rng.random((STUDIES, seeds)) for env in sorted(environments)}
    rows = []
    for title, truth in TRUTHS.items():
        p_different, p_equivalent, means = [], [], []
        for (_, part), own in zip(parts, differences, strict=True):
            mean, variance = 0.0, 0.0
            for env, values in zip(part.environments, own, strict=True):
                shift = 0 if truth is None else truth * WORTH_MENTIONING - values.mean()
                sample = (values + shift)[(drawn[env] * len(values)).astype(int)]
                mean = mean + sample.mean(1) / len(own)
                variance = variance + sample.var(1, ddof=1) / seeds / len(own) ** 2
            error, t = np.sqrt(variance) + 1e-12, stats.t(len(own) * (seeds - 1))
            means.append(mean)
            p_different.append(2 * t.sf(abs(mean) / error))
            sides = (mean + WORTH_MENTIONING) / error, (WORTH_MENTIONING - mean) / error
            p_equivalent.append(t.sf(np.minimum(*sides)))
        absent = holm(np.stack(p_equivalent, 1)) < LEVEL
        clear = (holm(np.stack(p_different, 1)) < LEVEL) & ~absent
        positive = np.stack(means, 1) > 0
        for outcome, cases in (
            ("absent", absent),
            ("shown", clear & positive),
            ("reversed", clear & ~positive),
        ):
            rows += [
                (name, _words(part), title, outcome, cases[:, place].mean())
                for place, (name, part) in enumerate(parts)
            ]
    return pd.DataFrame(rows, columns=["claim", "part", "truth", "outcome", "share"])


def _words(part: Part) -> str:
    where = part.environments[0] if len(part.environments) == 1 else "all"
    return f"{where}: {part.metric}, {part.variant} over {part.baseline or '0'}"


def main() -> None:
    """Entry point."""
    seeds = int(sys.argv[1]) if sys.argv[1:] else 20
    settings = read_study([Path("config.yaml"), Path("config/questions.yaml")]).metrics
    table = first_study(settings.moving_average)
    pd.set_option("display.width", 200, "display.max_rows", None, "display.max_colwidth", None)
    for family in FAMILIES:
        found = shares(family, table, settings, seeds)
        found["column"] = found["outcome"] + " if " + found["truth"]
        wide = found.pivot_table("share", ["claim", "part"], "column", sort=False)
        columns = ["absent if 0", "absent if 1/2", "shown if 1", "shown if 2", "shown if 4"]
        columns += [f"{outcome} if as seen" for outcome in ("absent", "shown", "reversed")]
        print(f"\n{family.title}, {seeds} seeds\n{wide[columns].round(2).to_string()}")


if __name__ == "__main__":
    main()
