"""Numbers as tools.show writes them."""

from pathlib import Path

import numpy as np
import pandas as pd

from mace_rl.config.reading import read_yaml
from mace_rl.config.results import MetricsConfig
from mace_rl.results.statistics import mean_interval

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = MetricsConfig.model_validate(read_yaml(ROOT / "config.yaml")["metrics"])


def mean(values: pd.Series, form: str = ".4g") -> str:
    """A mean over seeds with the interval of the tables."""
    numbers = values.to_numpy(np.float64)
    generator = np.random.default_rng(SETTINGS.bootstrap_seed)
    low, high = mean_interval(
        numbers, SETTINGS.confidence, SETTINGS.bootstrap_repetitions, generator
    )
    shown = [format(value, f"z{form}").replace("-", "−") for value in (numbers.mean(), low, high)]
    return f"{shown[0]} ({shown[1]} to {shown[2]})"


def short(value: float | str) -> str:
    """Four significant digits, with a true minus; an empty cell stays empty."""
    return f"{float(value):z.4g}".replace("-", "−") if value != "" else ""


def number(value: float | str, digits: int) -> str:
    """As many digits after the point, with a true minus; an empty cell stays empty."""
    return f"{float(value):z.{digits}f}".replace("-", "−") if value != "" else ""


def percent(share: float) -> str:
    return f"{100 * share:z.2f} %".replace("-", "−")
