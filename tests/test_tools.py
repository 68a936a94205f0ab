"""Tools that measure: what they say of what cannot be measured, in one line."""

from collections.abc import Callable
from pathlib import Path

import pytest
from shared import Bonanza, message

from tools import convergence_simulation, random_return


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["Foo-v0", "3"], "environment has 'Foo-v0', which is not in Gymnasium's registry"),
        (["CartPole-v9", "3"], "environment has 'CartPole-v9', which is not in Gymnasium's"),
        (["nope:Foo-v0", "3"], "in the settings of nope:Foo-v0 and"),
        (["CliffWalking-v1", "3"], "environment has 'CliffWalking-v1', which has no time limit"),
        (["CartPole-v1", "3", "no.yaml"], "no.yaml: cannot be read: "),
        (["CartPole-v1", "3", "three.yaml"], "config.yaml + three.yaml: metrics "),
        (["CartPole-v1", "3", "maps.yaml"], "CartPole-v1 cannot be made: "),
        (["CartPole-v1", "1"], "EPISODES is 1, but should be at least 2"),
        (["CartPole-v1", "-3"], "EPISODES is -3, but should be at least 2"),
    ],
)
def test_what_has_no_random_return(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: list[str], expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "three.yaml").write_text("metrics: 3\n")
    maps = "environment_settings: {CartPole-v1: {environment_arguments: {map_name: 4x4}}}\n"
    (tmp_path / "maps.yaml").write_text(maps)
    said = message(monkeypatch, random_return, "--", *words)
    assert said.startswith(f"random_return: {expected}")


def test_a_random_return_is_that_of_random_actions(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    register: Callable[..., str],
) -> None:
    """Of 1000 fair choices between 0 and 1 in each episode: 500 ± √250 / √40."""
    name = register("Bonanza-v0", Bonanza, 1000)
    monkeypatch.setattr("sys.argv", ["random_return", name, "40"])
    random_return.main()
    words = capsys.readouterr().out.replace(":", "").replace(")", "").split()
    assert words[0] == name and float(words[1]) == pytest.approx(500, abs=10)
    assert float(words[-1]) == pytest.approx(2.5, rel=0.4)


def test_a_random_return_is_that_of_the_study_s_environment(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    register: Callable[..., str],
    tmp_path: Path,
) -> None:
    """Half of as many choices as the configuration allows."""
    name = register("Bonanza-v0", Bonanza, 1000)
    settings = f"environment_settings:\n  {name}: {{max_episode_steps: 100}}\n"
    (tmp_path / "short.yaml").write_text(settings)
    monkeypatch.setattr("sys.argv", ["random_return", name, "40", str(tmp_path / "short.yaml")])
    random_return.main()
    assert float(capsys.readouterr().out.split()[1]) == pytest.approx(50, abs=4)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ([], "no ENVIRONMENT/VARIANT/seedN/episodes.csv in it"),
        (["CartPole-v1/ppo/seed0/checkpoint.pt"], "no ENVIRONMENT/VARIANT/seedN/episodes.csv in"),
        (["runs/CartPole-v1/ppo/seed0/episodes.csv"], "no ENVIRONMENT/VARIANT/seedN/episodes.csv"),
        (["Foo-v0/ppo/seed0/episodes.csv"], "'metrics.random_return.Foo-v0' is missing"),
    ],
)
def test_a_folder_that_gives_no_column(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, files: list[str], expected: str
) -> None:
    folder = tmp_path / "runs of a study"
    for file in files:
        (folder / file).parent.mkdir(parents=True)
        (folder / file).touch()
    said = message(monkeypatch, convergence_simulation, str(folder))
    assert said.startswith("convergence_simulation: ") and expected in said
    assert files == ["Foo-v0/ppo/seed0/episodes.csv"] or str(folder) in said
