"""The tools behind the figures of docs/method.md."""

import numpy as np
import pandas as pd
import pytest

from tools.stagnation import correlation
from tools.summary import summary


@pytest.mark.parametrize(("sign", "expected"), [(1, 1.0), (-1, -1.0), (0, np.nan)])
def test_stagnation_and_the_beta_that_follows_it(tmp_path, sign, expected):
    """A return that rises ever more slowly, and a β that follows that, its opposite, or nothing."""
    episodes = np.arange(300)
    returns = np.sqrt(episodes)
    # The slope at episode t + 1 falls with t, so β that rises with t follows stagnation.
    frame = pd.DataFrame({"extrinsic_return": returns, "beta": 0.5 + sign * episodes / 1000})
    frame.to_csv(tmp_path / "episodes.csv", index=False)
    assert correlation(tmp_path) == pytest.approx(expected, nan_ok=True)


def test_summary_by_hand():
    table = pd.DataFrame(
        {"env": ["A"] * 4, "variant": ["x"] * 2 + ["y"] * 2, "final_return": [1.0, 3.0, 5.0, 5.0]}
    )
    lines = summary(table, ["final_return"])
    assert lines[2].startswith("| A | x | 2 | 2 (-10.71 to 14.71)")  # ± 12.71, Student's t, 1 df
    assert lines[3].startswith("| A | y | 2 | 5 (5 to 5)") and len(lines) == 4
