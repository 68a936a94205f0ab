"""`tools.random_return`, which whoever adds an environment needs: its number, and mistakes."""

from collections.abc import Callable
from pathlib import Path

import pytest
from shared import Bonanza, message

from tools import random_return


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["CartPole-v9", "3"], "environment has 'CartPole-v9', which is not in Gymnasium's"),
        (["nope:Foo-v0", "3"], "in the settings of nope:Foo-v0 and"),
        (["CliffWalking-v1", "3"], "environment has 'CliffWalking-v1', which has no time limit"),
        (["CartPole-v1", "3", "no.yaml"], "no.yaml: cannot be read: "),
        (["CartPole-v1", "3", "maps.yaml"], "CartPole-v1 cannot be made: "),
        (["CartPole-v1", "1"], "EPISODES is 1, but should be at least 2"),
    ],
)
def test_what_has_no_random_return(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: list[str], expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    maps = "environment_settings: {CartPole-v1: {environment_arguments: {map_name: 4x4}}}\n"
    (tmp_path / "maps.yaml").write_text(maps)
    said = message(monkeypatch, random_return, "--", *words)
    assert said.startswith(f"random_return: {expected}")


def test_a_random_return_is_that_of_random_actions_in_the_study_s_environment(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    register: Callable[..., str],
    tmp_path: Path,
) -> None:
    """Of so many fair choices between 0 and 1 in each of 40 episodes."""
    name = register("Bonanza-v0", Bonanza, 1000)
    (tmp_path / "short.yaml").write_text(
        f"environment_settings:\n  {name}: {{max_episode_steps: 100}}\n"
    )
    for steps, files in ((1000, []), (100, [str(tmp_path / "short.yaml")])):
        monkeypatch.setattr("sys.argv", ["random_return", name, "40", *files])
        random_return.main()
        words = capsys.readouterr().out.replace(":", "").replace(")", "").split()
        error = (steps / 4 / 40) ** 0.5
        assert words[0] == name and float(words[1]) == pytest.approx(steps / 2, abs=4 * error)
        assert float(words[-1]) == pytest.approx(error, rel=0.4)
