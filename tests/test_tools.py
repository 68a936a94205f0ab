"""The tools behind the figures of docs/method.md."""

import numpy as np
import pandas as pd
import pytest

from tools.stagnation import correlation


@pytest.mark.parametrize(("sign", "expected"), [(1, 1.0), (-1, -1.0), (0, np.nan)])
def test_stagnation_and_the_beta_that_follows_it(tmp_path, sign, expected):
    """A return that rises ever more slowly, and a β that follows that, its opposite, or nothing."""
    episodes = np.arange(300)
    returns = np.sqrt(episodes)
    # The slope at episode t + 1 falls with t, so β that rises with t follows stagnation.
    frame = pd.DataFrame({"extrinsic_return": returns, "beta": 0.5 + sign * episodes / 1000})
    frame.to_csv(tmp_path / "episodes.csv", index=False)
    assert correlation(tmp_path) == pytest.approx(expected, nan_ok=True)
