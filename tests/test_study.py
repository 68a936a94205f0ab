"""The study: merging of settings, and a clear refusal of every kind of mistake."""

import copy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from mace_rl.hyperparameters import ConfigError
from mace_rl.study import load_study, merge, read_study, read_yaml, typed

CONFIG = Path(__file__).parents[1] / "config.yaml"
PLAIN = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
DELETE = object()


def changed(over: dict[str, Any], base: dict[str, Any] | None = None) -> dict[str, Any]:
    """A copy of config.yaml's content with values replaced, or deleted by `DELETE`."""
    result = copy.deepcopy(PLAIN if base is None else base)
    for key, value in over.items():
        if value is DELETE:
            del result[key]
        elif isinstance(value, dict) and isinstance(result.get(key), dict):
            result[key] = changed(value, result[key])
        else:
            result[key] = value
    return result


# What is changed, and what the message has to name: the key, the value, what would be right.
MISTAKES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "unknown key at the top": (
        {"enviroments": ["CartPole-v1"]},
        ["'enviroments'", "'environments'"],
    ),
    "unknown hyperparameter": (
        {"training": {"ppo": {"clpi": 0.2}}},
        ["training", "'ppo.clpi'", "0.2", "'clip'"],
    ),
    "unknown key of an environment": (
        {"environment_settings": {"HopperBulletEnv-v0": {"episode": 10}}},
        ["environment_settings.HopperBulletEnv-v0", "'episode'", "10", "'episodes'"],
    ),
    "unknown key of a variant": (
        {"variant_settings": {"mace_full": {"memory": {"capcity": 7}}}},
        ["variant_settings.mace_full", "'memory.capcity'", "7", "'capacity'"],
    ),
    "unknown key of a variant that is not selected": (
        {"variant_settings": {"mace_fixed_0.2": {"metaa": {}}}},
        ["variant_settings.mace_fixed_0.2", "'metaa'", "'meta'"],
    ),
    "unknown key of β's schedule": (
        {"variant_settings": {"mace_full": {"beta": {"kind": "meta", "initial": 0.4, "flor": 0}}}},
        ["variant_settings.mace_full", "flor"],
    ),
    "unknown kind of β": (
        {"variant_settings": {"mace_full": {"beta": {"kind": "mata"}}}},
        ["variant_settings.mace_full", "beta", "mata", "'meta'"],
    ),
    "incomplete β": (
        {"variant_settings": {"mace_fixed": {"beta": {"initial": DELETE}}}},
        ["variant_settings.mace_fixed", "beta", "initial", "missing"],
    ),
    "unknown key of metrics": (
        {"metrics": {"treshold": 0.5}},
        ["'metrics.treshold'", "'threshold'"],
    ),
    "unknown key of figure": ({"figure": {"colums": 2}}, ["'figure.colums'", "'columns'"]),
    "missing section": ({"metrics": DELETE}, ["'metrics'", "missing"]),
    "missing hyperparameter": (
        {"training": {"ppo": {"clip": DELETE}}},
        ["training", "'ppo.clip'", "missing"],
    ),
    "text for a number": (
        {"training": {"ppo": {"clip": "high"}}},
        ["training", "ppo.clip", "'high'", "number"],
    ),
    "YAML's 3e-4": (
        {"training": {"ppo": {"actor_learning_rate": "3e-4"}}},
        ["ppo.actor_learning_rate", "'3e-4'", "write 0.0003"],
    ),
    "quoted number of episodes": (
        {"environment_settings": {"HopperBulletEnv-v0": {"episodes": "6000"}}},
        ["environment_settings.HopperBulletEnv-v0", "episodes", "'6000'", "write 6000"],
    ),
    "fractional episodes": ({"training": {"episodes": 10.5}}, ["episodes", "10.5", "integer"]),
    "boolean for a number": ({"training": {"episodes": True}}, ["episodes", "True", "integer"]),
    "negative budget": (
        {"training": {"episodes": -5}},
        ["training", "episodes", "-5", "greater than 0"],
    ),
    "budget of zero": (
        {"environment_settings": {"HopperBulletEnv-v0": {"episodes": 0}}},
        ["environment_settings.HopperBulletEnv-v0", "episodes", "0"],
    ),
    "discount above 1": ({"training": {"ppo": {"discount": 1.5}}}, ["ppo.discount", "1.5", "1"]),
    "NaN": (
        {"training": {"ppo": {"clip": float("nan")}}},
        ["ppo.clip", "nan", "finite"],
    ),
    "more neighbours than capacity": (
        {"training": {"memory": {"capacity": 5}}},
        ["memory", "neighbours", "capacity"],
    ),
    "unknown environment": (
        {"environments": ["CartPole-v9"]},
        ["environments", "'CartPole-v9'", "'CartPole-v1'"],
    ),
    "environment without version": ({"environments": ["Acrobot"]}, ["'Acrobot'", "'Acrobot-v1'"]),
    "settings of an unknown environment": (
        {"environment_settings": {"HoperBulletEnv-v0": {"episodes": 5}}},
        ["environment_settings", "'HoperBulletEnv-v0'", "'HopperBulletEnv-v0'"],
    ),
    "environment without a time limit": (
        {"environments": ["CliffWalking-v1"]},
        ["environments", "'CliffWalking-v1'", "time limit"],
    ),
    "environment whose package is missing": (
        {"environments": ["LunarLander-v3"]},
        ["environments", "'LunarLander-v3'", "installed"],
    ),
    "environment in a namespace": (
        {"environments": ["phys2d/CartPole-v1"]},
        ["environments", "'phys2d/CartPole-v1'", "letters"],
    ),
    "environment that leaves the folder": ({"environments": ["../x"]}, ["'../x'", "letters"]),
    "no random return for an environment": (
        {"environments": ["MountainCar-v0"]},
        ["metrics.random_return.MountainCar-v0", "missing"],
    ),
    "unknown variant": (
        {"variants": ["ppo", "mace_ful"]},
        ["variants", "'mace_ful'", "'mace_full'"],
    ),
    "variant with a space": (
        {"variant_settings": {"mace full": {"beta": {"kind": "none"}}}},
        ["variant_settings", "'mace full'", "letters"],
    ),
    "variant with a pattern": (
        {"variant_settings": {"{seed}": {"beta": {"kind": "none"}}}},
        ["variant_settings", "'{seed}'", "letters"],
    ),
    "label of an unknown variant": (
        {"labels": {"mace_ful": "x"}},
        ["labels", "'mace_ful'", "'mace_full'"],
    ),
    "colour of an unknown variant": ({"colours": {"pppo": "k"}}, ["colours", "'pppo'", "'ppo'"]),
    "missing label": ({"labels": {"ppo": DELETE}}, ["labels.ppo", "missing"]),
    "missing colour": ({"colours": {"ppo": DELETE}}, ["colours.ppo", "missing"]),
    "no colour": ({"colours": {"ppo": "bluish"}}, ["colours.ppo", "'bluish'", "tab:blue"]),
    "duplicate seeds": ({"seeds": [0, 1, 0]}, ["seeds", "[0, 1, 0]", "0 should be there once"]),
    "duplicate environments": (
        {"environments": ["CartPole-v1", "CartPole-v1"]},
        ["environments", "'CartPole-v1' should be there once"],
    ),
    "duplicate variants": (
        {"variants": ["ppo", "ppo"]},
        ["variants", "'ppo' should be there once"],
    ),
    "one seed that is no list": ({"seeds": 3}, ["seeds", "3", "list"]),
    "negative seed": ({"seeds": [-1]}, ["seeds.0", "-1", "0"]),
    "fractional seed": ({"seeds": [0.5]}, ["seeds.0", "0.5", "integer"]),
    "seed beyond 32 bits": ({"seeds": [2**32]}, ["seeds.0", "4294967296"]),
    "no seeds": ({"seeds": []}, ["seeds", "[]", "at least 1"]),
    "no environments": ({"environments": []}, ["environments", "[]", "at least 1"]),
    "no variants": ({"variants": []}, ["variants", "[]", "at least 1"]),
    "empty section": ({"training": None}, ["training", "None", "dictionary"]),
    "list for a section": ({"variant_settings": ["ppo"]}, ["variant_settings", "dictionary"]),
    "environment among the hyperparameters": (
        {"training": {"environment": "CartPole-v1"}},
        ["training.environment", "'CartPole-v1'", "environments"],
    ),
    "seed of a variant": (
        {"variant_settings": {"ppo": {"seed": 3}}},
        ["variant_settings.ppo.seed", "3", "seeds"],
    ),
    "results folder that is no text": ({"results": 5}, ["results", "5", "string"]),
    "results folder without a name": ({"results": " "}, ["results", "' '", "folder"]),
    "results folder with a pattern": ({"results": "r/{env}"}, ["results", "'r/{env}'", "folder"]),
    "results folder in a file": ({"results": __file__ + "/x"}, ["results", __file__, "is a file"]),
    "key that is no text": ({7: 8}, ["'7'", "unknown"]),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_named_in_one_line(name: str) -> None:
    change, expected = MISTAKES[name]
    with pytest.raises(ConfigError) as caught:
        load_study(changed(change), "some.yaml")
    message = str(caught.value)
    assert message.startswith("some.yaml: ")
    assert "\n" not in message
    for fragment in expected:
        assert fragment in message.removeprefix("some.yaml: ")


@pytest.mark.parametrize("config", [None, [], "text", 3])
def test_configuration_that_is_no_mapping(config: Any) -> None:
    with pytest.raises(ConfigError, match="keys with values"):
        load_study(config, "some.yaml")


def test_settings_go_over_one_another_in_order() -> None:
    study = load_study(
        changed(
            {
                "training": {"episodes": 1, "ppo": {"clip": 0.1, "epochs": 1}},
                "environment_settings": {
                    "CartPole-v1": {
                        "episodes": 2,
                        "ppo": {"clip": 0.2},
                        "meta": {"hidden_units": 2},
                    }
                },
                "variant_settings": {"mace_full": {"episodes": 3, "ppo": {"discount": 0.3}}},
            }
        ),
        "test",
    )
    plain = study.run_config("Acrobot-v1", "ppo", 0)
    assert (plain.episodes, plain.ppo.clip, plain.ppo.epochs) == (1, 0.1, 1)
    assert plain.ppo.discount == PLAIN["training"]["ppo"]["discount"]
    environment = study.run_config("CartPole-v1", "ppo", 7)
    assert (environment.episodes, environment.ppo.clip, environment.ppo.epochs) == (2, 0.2, 1)
    assert (environment.meta.hidden_units, environment.seed) == (2, 7)
    both = study.run_config("CartPole-v1", "mace_full", 0)
    assert (both.episodes, both.ppo.clip, both.ppo.discount) == (3, 0.2, 0.3)
    assert (both.environment, both.variant) == ("CartPole-v1", "mace_full")


def test_beta_is_replaced_as_a_whole() -> None:
    exponential = {"kind": "exponential", "initial": 0.4, "decay": 0.9, "floor": 0.1}
    study = load_study(changed({"training": {"beta": exponential}}), "test")
    assert study.run_config("CartPole-v1", "ppo", 0).beta.model_dump() == {"kind": "none"}


def test_run_config_of_a_run_outside_the_lists() -> None:
    study = load_study(changed({"environments": ["CartPole-v1"], "seeds": [0]}), "test")
    assert study.run_config("Acrobot-v1", "mace_fixed_0.2", 99).beta.initial == 0.2
    for arguments, fragment in (
        (("Acrobat-v1", "ppo", 0), "Acrobot-v1"),
        (("Acrobot-v1", "pop", 0), "'ppo'"),
        (("Acrobot-v1", "ppo", -1), "seed is -1"),
        (("Acrobot-v1", "ppo", 2**32), "seed is 4294967296"),
    ):
        with pytest.raises(ConfigError, match=fragment):
            study.run_config(*arguments)


def test_files_are_read_over_one_another(tmp_path: Path) -> None:
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text("seeds: [8, 9]\ntraining: {ppo: {clip: 0.3}}\n")
    study = read_study([CONFIG, overlay])
    assert study.seeds == [8, 9]
    run = study.run_config("CartPole-v1", "ppo", 8)
    assert (run.ppo.clip, run.ppo.epochs) == (0.3, PLAIN["training"]["ppo"]["epochs"])
    overlay.write_text("seeds: []\n")
    with pytest.raises(ConfigError, match=r"config\.yaml \+ .*overlay\.yaml: seeds"):
        read_study([CONFIG, overlay])


def test_merge_as_snakemake_does() -> None:
    from snakemake.utils import update_config

    base = {"a": {"b": 1, "c": {"d": 2}}, "e": [1, 2], "f": 3, "g": {"h": 1}}
    over = {"a": {"c": {"d": 4, "x": 5}}, "e": [9], "f": {"y": 6}, "g": None}
    expected = copy.deepcopy(base)
    update_config(expected, over)
    unchanged = copy.deepcopy(base)
    assert merge(base, over) == expected
    assert base == unchanged


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "cannot be read: No such file"),
        (b"", "empty"),
        (b"- a\n- b\n", "keys with values"),
        (b"a: [1\nb: 2\n", "line 2, column 2: not valid YAML"),
        (b"a: 1\n\tb: 2\n", "line 2"),
        (b"a: \xff\n", "not UTF-8"),
        (b"a: 1\nb: {c: 1, c: 2}\n", "line 2, column 11: .*'c' occurs twice"),
        (b"a: \x07\n", "not valid YAML"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, text: bytes | None, expected: str) -> None:
    file = tmp_path / "file.yaml"
    if text is not None:
        file.write_bytes(text)
    with pytest.raises(ConfigError, match=expected) as caught:
        read_yaml(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["0", "1"], [0, 1]),  # --config seeds=[0,1]
        (
            {"ppo": {"clip": "0.5", "minibatch_size": "null"}},
            {"ppo": {"clip": 0.5, "minibatch_size": None}},
        ),
        (["ppo"], ["ppo"]),
        ("7", "7"),  # Snakemake itself tells 7 from '7' here
        (3, 3),
    ],
)
def test_numbers_from_the_command_line(given: Any, expected: Any) -> None:
    assert typed(given) == expected


def test_planning_imports_nothing_slow() -> None:
    code = "import sys, mace_rl.study, mace_rl.sources, mace_rl.progress; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"torch", "numba", "pandas", "scipy.stats", "matplotlib.pyplot", "pybullet"}
