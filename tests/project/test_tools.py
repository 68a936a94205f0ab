"""tools/: kept tables, the schema, random returns, the archive for a DOI."""

import json
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from shared import ROOT, Bonanza, refusal
from snakemake.exceptions import WorkflowError
from snakemake.utils import validate

from mace_rl.config.reading import read_options, read_yaml
from mace_rl.library import settings
from mace_rl.runs import run
from mace_study.config.study import read_study
from tools import ceiling, kept_runs, random_return, schema, tables, worlds


def test_editors_are_told_what_a_configuration_may_be() -> None:
    """By Snakemake's check of a schema."""
    kept = json.loads(schema.GOAL.read_text(encoding="utf-8"))
    assert kept == schema.schema(), "python -m tools.schema makes it anew"
    files = [ROOT / "config.yaml", *(ROOT / "config").rglob("*.yaml")]
    files += [ROOT / "examples" / "environments.yaml", ROOT / "reference" / "runs.yaml"]
    for file in (file for file in files if file.name != "claims.yaml"):
        validate(read_yaml(file), str(schema.GOAL))
    for wrong in (
        "seeds=[-1]",
        "seeds=3-",
        "training={ppo: {clp: 0.2}}",
        "training={novelty: {neighbours: 10}}",
        "environment_settings={CartPole-v1: {episodes: many}}",
        "variant_settings={mine: {beta: {kind: metta}}}",
        "variant_settings={mine: {betta: {kind: meta}}}",
    ):
        with pytest.raises(WorkflowError, match="Error validating"):
            validate(read_options([wrong]), str(schema.GOAL))


@pytest.mark.slow
def test_a_kept_study_is_made_compared_and_reported(tmp_path: Path, monkeypatch, capsys) -> None:
    shutil.copytree(ROOT / "config", tmp_path / "config")
    shutil.copy(ROOT / "config.yaml", tmp_path)
    small = {"environments": ["CartPole-v1"], "variants": ["ppo"], "seeds": [0, 1]}
    small |= {"training": {"episodes": 60}, "metrics": {"comparisons": []}}
    (tmp_path / "config/small.yaml").write_text(yaml.safe_dump(small))
    study = read_study([tmp_path / "config.yaml", tmp_path / "config/small.yaml"])
    for seed in (0, 1):
        folder = tmp_path / f"results/runs/CartPole-v1/ppo/seed{seed}"
        run.run(study.run_config("CartPole-v1", "ppo", seed), folder)
    kept_runs.pack(tmp_path / "results", tmp_path / "reference/worlds/small")
    kept, archive = (
        tmp_path / "reference/tables/small",
        "reference/worlds/small/CartPole-v1.parquet",
    )

    monkeypatch.setattr(tables, "STUDIES", {"small": ("small",)})
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.chdir(tmp_path)

    def tabulate(*words: str) -> tuple[str, str]:
        """What it printed, and what it ended with."""
        monkeypatch.setattr(sys, "argv", ["tables", *words])
        said = ""
        try:
            tables.main()
        except SystemExit as ended:
            said = str(ended.code)
        return capsys.readouterr().out, said

    stale = tmp_path / "results/tables/small/stale"
    stale.parent.mkdir(parents=True)
    stale.touch()
    names = ["metrics.csv", "comparisons.csv", "aggregate.csv"]
    names += ["figure1.png", "figure2.png", "every_seed.png", "README.md"]
    made = "7 tables and figures of 1 studies from 2 runs, in results/tables\n"
    new = "".join(f"new: reference/tables/small/{name}\n" for name in names)
    assert tabulate() == (new + made, "") and not stale.exists()
    readme = (kept / "README.md").read_text()
    assert readme.startswith("# small\n") and readme.count("![") == 3
    assert "![figure1](figure1.png)" in readme and "## Mean return of training" in readme

    metrics = (kept / "metrics.csv").read_bytes()
    (kept / "metrics.csv").write_bytes(metrics + b"\n")
    (kept / "README.md").unlink()
    (kept / "claims.json").touch()
    (kept.parent / "left").mkdir()
    named = "tables: not those that are kept: reference/tables/small/metrics.csv, "
    named += "reference/tables/small/README.md, "
    named += "reference/tables/small/claims.json (no longer made), reference/tables/left"
    assert tabulate("--check") == (made, named)
    (kept / "metrics.csv").write_bytes(metrics)
    (kept / "claims.json").unlink()
    (kept.parent / "left").rmdir()
    (kept / "README.md").write_text("stale")
    assert tabulate() == ("renewed: reference/tables/small/README.md\n" + made, "")
    assert (kept / "README.md").read_text() == readme

    over = tmp_path / "config/small.yaml"
    over.write_text(over.read_text().replace("- 1\n", "- 2\n"))
    assert tabulate() == ("", f"tables: small: {archive} lacks ppo seed 2")
    (tmp_path / archive).write_bytes((tmp_path / archive).read_bytes()[:1000])
    assert tabulate()[1].startswith(f"tables: small: {archive} is not as")


@pytest.mark.parametrize(
    ("tool", "words", "said"),
    [
        (tables, ["--cores", "0"], "--cores is '0', but should be all, or at least 1"),
        (tables, ["--cores", "two"], "--cores is 'two', but should be all, or at least 1"),
        (worlds, ["nowhere"], "worlds: nowhere has no tuned/metrics.csv"),
        (ceiling, ["A-v1", "kept", "--seeds", "3", "3"], "--seeds should be FIRST < END"),
        (ceiling, ["A-v1", "kept"], "ceiling: environment has 'A-v1', which is not in"),
    ],
)
def test_a_tool_refuses_in_one_line_in_any_folder(
    monkeypatch, capsys, tmp_path, tool, words, said
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kept").write_text("of another time")
    monkeypatch.setattr("sys.argv", [tool.__name__, *words])
    with pytest.raises(SystemExit) as ended:
        tool.main()
    assert (tmp_path / "kept").read_text() == "of another time"
    assert said in f"{capsys.readouterr().err}{ended.value}"


# --- random_return --------------------------------------------------------------------------------


def test_a_random_return_has_the_study_s_wrappers(tmp_path) -> None:
    over = tmp_path / "over.yaml"
    wrapper = "{wrapper: 'gymnasium.wrappers:TransformReward', arguments: {func: null}}"
    own = wrapper.replace("TransformReward", "ClipReward").replace("func: null", "max_reward: 0.5")
    over.write_text(f"environment_settings: {{CartPole-v1: {{environment_wrappers: [{own}]}}}}")
    lengths, halves = (
        random_return.random_returns(settings("CartPole-v1", "ppo", config=files), 20)
        for files in ([], [str(over)])
    )
    assert (halves == lengths / 2).all()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["CartPole-v9", "3"], "environment has 'CartPole-v9', which is not in Gymnasium's"),
        (["nope:Foo-v0", "3"], "in the settings of nope:Foo-v0 and"),
        (["CartPole-v1", "3", "no.yaml"], "no.yaml: cannot be read: "),
        (
            ["CartPole-v1", "3", "maps.yaml"],
            "environment 'CartPole-v1' with {'map_name'",
        ),
        (["CartPole-v1", "1"], "EPISODES is 1, but should be at least 2"),
    ],
)
def test_what_has_no_random_return(monkeypatch, tmp_path, words, expected) -> None:
    monkeypatch.chdir(tmp_path)
    maps = "environment_settings: {CartPole-v1: {environment_arguments: {map_name: 4x4}}}\n"
    (tmp_path / "maps.yaml").write_text(maps)
    said = refusal(monkeypatch, "--", *words, tool=random_return)
    assert said.startswith(f"random_return: {expected}")


def test_a_random_return_is_that_of_random_actions(monkeypatch, capsys, register, tmp_path) -> None:
    """Of so many fair choices between 0 and 1 in each of 40 episodes."""
    name, short = register("Bonanza-v0", Bonanza, 1000), tmp_path / "short.yaml"
    own = f"environments: [{name}]\nenvironment_seeds: {{{name}: [3]}}\n"  # not complete without
    short.write_text(f"{own}environment_settings: {{{name}: {{max_episode_steps: 100}}}}\n")
    for steps, files in ((1000, []), (100, [str(short)])):
        monkeypatch.setattr("sys.argv", ["random_return", name, "40", *files])
        random_return.main()
        words = capsys.readouterr().out.replace(":", "").replace(")", "").split()
        error = (steps / 4 / 40) ** 0.5
        assert words[0] == name and float(words[1]) == pytest.approx(steps / 2, abs=4 * error)
        assert float(words[-1]) == pytest.approx(error, rel=0.4)
