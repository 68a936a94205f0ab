"""Tools that measure: what they say of what cannot be measured, in one line."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from shared import Bonanza

from tools import convergence_simulation, random_return, show, tables


def message(monkeypatch: pytest.MonkeyPatch, tool: ModuleType, *words: str) -> str:
    """What the tool exits with."""
    monkeypatch.setattr("sys.argv", [tool.__name__, *words])
    with pytest.raises(SystemExit) as ended:
        tool.main()
    assert isinstance(ended.value.code, str) and "\n" not in ended.value.code
    return ended.value.code


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["Foo-v0", "3"], "ENVIRONMENT is 'Foo-v0', which cannot be made: "),
        (["CartPole-v9", "3"], "ENVIRONMENT is 'CartPole-v9', which cannot be made: "),
        (["nope:Foo-v0", "3"], "ENVIRONMENT is 'nope:Foo-v0', which cannot be made: "),
        (["CartPole-v1", "1"], "EPISODES is 1, but should be at least 2"),
        (["CartPole-v1", "-3"], "EPISODES is -3, but should be at least 2"),
    ],
)
def test_what_has_no_random_return(
    monkeypatch: pytest.MonkeyPatch, words: list[str], expected: str
) -> None:
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


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["ledger", "nowhere"], "nowhere/claims.json: No such file or directory"),
        (["means", "study", "speed"], "there is no 'speed' in what study has"),
        (["parts", "study", "fancy"], "there is no 'fancy' in what study has"),
        (["improvement", "study", "speed"], "study/comparisons.csv has no metric 'speed'"),
        (["ledger", "study", "more"], "ledger does not take 'more'"),
        (["together", "study"], "together wants a variant and those to compare it with"),
        (["together", "study", "ppo", "other"], "no environment has runs of both 'ppo' and"),
    ],
)
def test_what_is_not_there_to_be_shown(
    monkeypatch: pytest.MonkeyPatch, words: list[str], expected: str
) -> None:
    monkeypatch.chdir(Path(__file__).parents[1] / "reference" / "tables")
    assert message(monkeypatch, show, *words).startswith(f"show: {expected}")


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


def test_tables_runs_each_script_in_a_process_of_its_own_and_hears_how_it_ended(
    tmp_path: Path,
) -> None:
    script, trace = tmp_path / "script.py", tmp_path / "trace"
    jobs, scripts = tables.fork.Pipe()
    server = tables.fork.Process(target=tables.run_scripts, args=(jobs, scripts))
    server.start()
    scripts.close()
    note = f"import os\nopen({str(trace)!r}, 'a').write(f'{{__name__}} {{os.getpid()}}\\n')\n"
    found = []
    for end in ("", "raise SystemExit(3)", "raise ValueError", "os.kill(os.getpid(), 9)"):
        script.write_text(note + end, encoding="utf-8")
        jobs.send(str(script))
        found.append(jobs.recv())
    assert found == [0, 3, 1, -9]
    names, processes = zip(*map(str.split, trace.read_text().splitlines()), strict=True)
    assert set(names) == {"__main__"} and len({*processes, str(server.pid)}) == 5
    jobs.close()  # as where Snakemake is killed
    server.join(10)
    assert server.exitcode is not None
