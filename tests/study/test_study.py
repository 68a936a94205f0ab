"""The study: merging of settings, and a clear refusal of every kind of mistake."""

import copy
import os
import re
import subprocess
import sys
import unicodedata
from pathlib import Path
from typing import Any

import matplotlib
import pytest
import yaml
from matplotlib.colors import to_hex
from matplotlib.ft2font import FT2Font
from shared import refused

from mace_rl.config.reading import _read, merge, read_options, read_yaml
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError, check
from mace_study.compare.claims_config import read_claims
from mace_study.config.study import LABEL, load_study, read_study
from mace_study.plan import Plan

CONFIG = Path(__file__).parents[2] / "config.yaml"
RULES = CONFIG.parent / "workflow" / "rules"
ROOT = CONFIG.parent
PLAIN = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))


def changed(over: dict[str, Any]) -> dict[str, Any]:
    """config.yaml's content with values replaced, or deleted where they are "DELETE"."""

    def without(part: Any) -> Any:
        if not isinstance(part, dict):
            return copy.deepcopy(part)
        return {key: without(value) for key, value in part.items() if value != "DELETE"}

    return without(merge(PLAIN, over))


# What is read over config.yaml  # what the message names: the key, the value, what would be right
MISTAKES = """
enviroments: [CartPole-v1]  # 'enviroments', 'environments'
7: 8  # unknown, '7'
training: {ppo: {clpi: 0.2}}  # training, 'ppo.clpi', 0.2, 'clip'
environment_settings: {Acrobot-v1: {episode: 1}}  # settings.Acrobot-v1, 'episode', 'episodes'
variant_settings: {mace_full: {memory: {capcity: 7}}}  # mace_full, 'memory.capcity', 7, 'capacity'
metrics: {comparisons: [[mace_ful, ppo]]}  # metrics.comparisons, 'mace_ful', 'mace_full'
variant_settings: {mace_full: {beta: {kind: mata}}}  # settings.mace_full, beta, mata, 'meta'
variant_settings: {mace_fixed: {beta: {initial: DELETE}}}  # mace_fixed, 'beta.initial', missing
variant_settings: {mace_fixed: {beta: {floor: 0.5}}}  # beta, floor is 0.5, exceed initial, 0.4
variant_settings: {x: {beta: {kind: constant, value: 10.5}}}  # beta.value is 10.5, equal to 10
metrics: {confidence: 95}  # metrics.confidence, 95, less than 1
metrics: {random_return: {CartPole-v1: .nan}}  # metrics.random_return.CartPole-v1, nan, finite
metrics: {constants: {learned: mace_full, fixed: []}}  # metrics.constants.fixed, [], 1 item
metrics: {constants: {learned: mace_full, fixed: [nix]}}  # metrics.constants, 'nix'
metrics: {constants: {learned: ppo, fixed: [ppo]}}  # metrics, constants.fixed, learned, 'ppo'
training: {ppo: {clip: DELETE}}  # training, 'ppo.clip', missing
training: {ppo: {clip: high}}  # training, ppo.clip, 'high', number
training: {ppo: {actor_learning_rate: '3e-4'}}  # ppo.actor_learning_rate, '3e-4', write 0.0003
training: {episodes: 1e3}  # episodes, 1000.0, integer (write 1000)
training: {episodes: 1_000}  # episodes, '1_000', write 1000
training: {ppo: {scale_rewards: no}}  # ppo.scale_rewards, 'no', write true or false
training: {episodes: true}  # episodes, True, integer
training: {memory: {capacity: 5}}  # memory, neighbours, capacity
training: {engine: jax}  # engine, 'jax', 'torch'
training: {novelty: {kind: custom}}  # training, novelty, estimator, kind
training: null  # training, None, dictionary
training: {environment: CartPole-v1}  # training.environment, 'CartPole-v1', environments
training: {ppo: {network: {kind: torch}}}  # ppo.network, module, missing
training: {ppo: {network: {kind: torch, module: 'a:B'}}}  # engine, 'compiled', "torch"
training: {ppo: {network: {kind: torch, module: net}}}  # module, 'net', package.module:Name
metrics: {custom: [no_such:metric]}  # metrics.custom, 'no_such:metric'
environments: [no_such:Walk-v0]  # environment, 'no_such:Walk-v0', no_such
environments: [CartPole-v9]  # environment, 'CartPole-v9', 'CartPole-v1'
environment_settings: {HoperBulletEnv-v0: {}}  # 'HoperBulletEnv-v0', 'HopperBulletEnv-v0'
environments: [LunarLander-v3]  # environment, 'LunarLander-v3', installed
environments: [a/b/CartPole-v1]  # environment, 'a/b/CartPole-v1', a namespace and '/'
environments: [../x]  # '../x', letters
environments: [MountainCar-v0]  # metrics.random_return.MountainCar-v0, missing
environments: [CartPole-v1, CartPole-v1]  # environments, 'CartPole-v1' should be there once
variants: [ppo, mace_ful]  # variants, 'mace_ful', 'mace_full'
variant_settings: {'{seed}': {beta: {kind: none}}}  # variant_settings, '{seed}', letters
variant_settings: {LONG: {beta: {kind: none}}}  # variant_settings, 'xxx, up to 200
variants: [ppo, True]  # variants.1, True, text, quotes
variant_settings: {mace_ful: {label: x}}  # variant_settings.mace_ful, beta, missing
variant_settings: {ppo: {label: 3}}  # ppo.label, 3
variant_settings: {ppo: {label: a}, mace_full: {label: a}}  # 2, label 'a', own
variant_settings: {ppo: {label: _plain}}  # variant_settings.ppo.label, '_plain', without '_'
variant_settings: {ppo: {label: "a\\nb"}}  # variant_settings.ppo.label, 'a\\nb', one line
variant_settings: {ppo: {colour: bluish}}  # variant_settings.ppo.colour, 'bluish', tab:blue
variant_settings: {ppo: {memory: {capacity: 7}}}  # settings.ppo, 'memory', 'none' does not use
variant_settings: {mace_full: {beta: {objective: {recent: 1}}}}  # recent, 1, or equal to 2
variant_settings: {ppo: {seed: 3}}  # variant_settings.ppo.seed, 3, seeds
variant_settings: {x: {beta: BETA, bonus: {kind: rnb}}}  # settings.x, bonus is {'kind': 'rnb'}
variant_settings: {x: {beta: BETA, bonus: {kind: rnd}}}  # and extras/ has this one, kind: custom
variant_settings: {x: {beta: BETA, bonus: {kind: curiosity, relevant: 3}}}  # 'bonus.relevant', 3
variant_settings: {x: {beta: BETA, bonus: {kind: custom, estimator: n:N}}}  # estimator has 'n:N'
variant_settings: {x: {beta: BETA, bonus: null}}  # the section 'bonus' is missing
variant_settings: {x: {beta: BETA, bonus: OWN, memory: {capacity: 9}}}  # 'memory', kind 'custom'
variant_settings: {x: {beta: BETA, bonus: BARE, memory: {capacity: 9}}}  # 'memory', bonus.relevance
seeds: [0, 1, 0]  # seeds, [0, 1, 0], 0 should be there once
seeds: [4294967296]  # seeds.0, 4294967296
environment_variants: {CartPole-v1: [mace_score]}  # environment_variants.CartPole-v1, ppo
environment_variants: {CartPole-v1: [mace_ful]}  # environment_variants.CartPole-v1, 'mace_ful'
seeds: 5-3  # seeds, '5-3', FIRST-LAST
seeds: 3-  # seeds, '3-', FIRST-LAST
environment_seeds: {HopperBulletEnvv0: [3]}  # environment_seeds, 'HopperBulletEnvv0', nearest
results: 2024.10  # results, 2024.1, text, quotes
results: LONG  # results, 'xxx, at most 255
results: 'r/{env}'  # results, 'r/{env}', folder
results: CONFIG/x  # results, CONFIG, is a file
training: {environment_arguments: {map_name: null}}  # environment_arguments, map_name, FrozenLake
training: {memory: {capacity: 1000000000000}}  # memory.capacity, less than or equal to 10000000
"""


WORDS = {"CONFIG": str(CONFIG), "LONG": 256 * "x", "BETA": "{kind: constant, value: 1.0}"}
WORDS |= {"OWN": "{kind: custom, estimator: 'test_extras:Fixed'}"}
WORDS |= {"BARE": "{kind: curiosity, relevance: false}"}


def test_seeds_may_be_ranges_and_an_environment_may_have_some_variants_only() -> None:
    few = {"environment_variants": {"CartPole-v1": ["mace_full", "ppo"]}, "seeds": ["0-2", 7]}
    study = load_study(changed(few | {"environment_seeds": {"CartPole-v1": "4-5"}}), "here")
    found = [run for run in study.runs() if run[0] == "CartPole-v1"]
    assert found == [
        ("CartPole-v1", name, seed) for name in ("ppo", "mace_full") for seed in (4, 5)
    ]
    others = [run[1:] for run in study.runs() if run[0] == "Acrobot-v1"]
    assert others == [(name, seed) for name in study.variants for seed in (0, 1, 2, 7)]


@pytest.mark.parametrize("line", MISTAKES.strip().splitlines())
def test_mistake_is_named_in_one_line(line: str) -> None:
    for name, text in WORDS.items():
        line = line.replace(name, text)
    change, _, expected = line.partition("  # ")
    with refused(ConfigError, "^some.yaml: ") as caught:
        load_study(changed(_read(change, "here")), "some.yaml")
    message = str(caught.value).removeprefix("some.yaml: ")
    assert [fragment for fragment in expected.split(", ") if fragment not in message] == []


LAYERS = """
training: {episodes: 1, ppo: {clip: 0.1, epochs: 1}, beta: {kind: constant, value: 0.4}}
environment_settings: {CartPole-v1: {episodes: 2, ppo: {clip: 0.2}, meta: {chunks: 2}}}
variant_settings: {mace_full: {episodes: 3, ppo: {discount: 0.3}}}
"""


def test_settings_go_over_one_another_in_order() -> None:
    study = load_study(changed(yaml.safe_load(LAYERS)), "test")
    plain = study.run_config("Acrobot-v1", "ppo", 0)
    assert (plain.episodes, plain.ppo.clip, plain.ppo.epochs) == (1, 0.1, 1)
    assert plain.beta.model_dump() == {"kind": "none"}  # replaced as a whole
    assert plain.ppo.discount == PLAIN["training"]["ppo"]["discount"]
    environment = study.run_config("CartPole-v1", "mace_fixed", 7)
    assert (environment.episodes, environment.ppo.clip, environment.ppo.epochs) == (2, 0.2, 1)
    assert environment.seed == 7
    both = study.run_config("CartPole-v1", "mace_full", 0)
    assert (both.episodes, both.ppo.clip, both.ppo.discount) == (3, 0.2, 0.3)
    assert (both.environment, both.variant) == ("CartPole-v1", "mace_full")
    assert both.meta.chunks == 2


SECTIONS = {"memory", "novelty", "meta"}


@pytest.mark.parametrize(
    ("variant", "used"),
    [("ppo", set()), ("mace_fixed", {"memory", "novelty"}), ("mace_full", SECTIONS)],
)
def test_a_run_holds_the_sections_that_its_variant_uses(variant: str, used: set[str]) -> None:
    """So that a change of the others leaves its settings, and with them its runs, alone."""
    over = {"memory": {"capacity": 77}, "novelty": {"knn_weight": 0.3}, "meta": {"chunks": 7}}
    studies = [load_study(changed({"training": one}), "test") for one in ({}, over)]
    plain, other = (study.run_config("CartPole-v1", variant, 0) for study in studies)
    assert SECTIONS & set(plain.settings()) == used
    assert {key for key in SECTIONS if getattr(plain, key) is not None} == used
    settings, others = plain.settings(), other.settings()
    assert {key for key in settings if settings[key] != others[key]} == used
    assert check(RunConfig, settings, "run.json") == plain


def test_labels_and_colours_stand_with_the_variants() -> None:
    look = {"label": "PPO itself", "colour": "k"}
    more = {"ppo": look, "mine": {"beta": {"kind": "none"}}}
    settings = {"variants": ["mine", "ppo"], "variant_settings": more}
    study = load_study(changed(settings), "test")
    assert study.labels == {"mine": "mine", "ppo": "PPO itself"}
    assert study.colours == {"mine": "tab:blue", "ppo": "k"}
    assert not {"label", "colour"} & set(study.run_config("CartPole-v1", "ppo", 0).settings())


def test_files_are_read_over_one_another(tmp_path: Path) -> None:
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text(
        "environments: [Acrobot-v1, HopperBulletEnv-v0]\nvariants: [ppo]\nseeds: [8, 9]\n"
        "environment_seeds: {HopperBulletEnv-v0: [3]}\ntraining: {ppo: {clip: 0.3}}\n"
    )
    study = read_study([CONFIG, overlay])
    short = [("Acrobot-v1", "ppo", 8), ("Acrobot-v1", "ppo", 9)]
    assert study.runs() == [*short, ("HopperBulletEnv-v0", "ppo", 3)]
    run = study.run_config("CartPole-v1", "ppo", 8)
    assert (run.ppo.clip, run.ppo.epochs) == (0.3, PLAIN["training"]["ppo"]["epochs"])
    overlay.write_text("seeds: []\n")
    with pytest.raises(ConfigError, match=r"config\.yaml \+ .*overlay\.yaml: seeds"):
        read_study([CONFIG, overlay])


def laughs(form: str) -> bytes:
    tens = (", ".join([f"*x{i}"] * 10) for i in range(8))
    rest = (f"x{i}: &x{i} " + form.format(ten) for i, ten in enumerate(tens, 1))
    return "\n".join(["x0: &x0 {a: 1}", *rest]).encode()


FILES = sorted(
    {*(CONFIG.parent / "config").rglob("*.yaml")} - {CONFIG.parent / "config/claims.yaml"}
)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_study_of_the_project_can_be_carried_out(path: Path) -> None:
    """By the command that its file has."""
    (files,) = re.findall(
        "^#.* --configfile ([a-z./ ]*[a-z])", path.read_text("utf-8"), re.MULTILINE
    )
    layers = [CONFIG.parent / name for name in files.split()]
    assert layers[-1] == path
    study = read_study([CONFIG, *layers])
    for run in study.runs():
        study.run_config(*run)
    study.metrics.within(study.variants_of)
    read_claims(study, CONFIG.parent / study.claims)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "cannot be read: No such file"),
        (b"", "empty"),
        (b"- a\n- b\n", "keys with values"),
        (b"a: [1\nb: 2\n", "line 2, column 2: not valid YAML"),
        (b"a: \xff\n", "not UTF-8"),
        (b"a: 1\nb: {c: 1, c: 2}\n", "line 2, column 11: .*'c' occurs twice"),
        (b"a: \x07\n", "not valid YAML"),
        (b"a: " + 2000 * b"[", "line 1, column 53: .*more than 50 levels"),
        (b"? {a: b}\n", "line 1, column 3: .*a key that is a list or mapping"),
        (b"a: &a [*a]", "line 1, column 8: .*aliases"),
        (b"a: &a {<<: *a}", "line 1, column 12: .*aliases"),
        (laughs("[{}]"), "line 6, column .*aliases"),
        (laughs("{{<<: [{}]}}"), "line 6, column .*aliases"),
        (b"a: !!set {b}", "the tag 'tag:yaml.org,2002:set'"),
        (b"{<<: {a: 1}, <<: {b: 1}}", "'<<' occurs twice"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, text: bytes | None, expected: str) -> None:
    file = tmp_path / "file.yaml"
    if text is not None:
        file.write_bytes(text)
    with refused(ConfigError, f"^{file}.*{expected}"):
        read_yaml(file)


TEXTS = ["2024_11_25", "2024-11-25", "12:30", "~/x", "NA", "None", "no", "y", "007", "0o17", "0x1F"]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("[0,1]", [0, 1]),
        ("{a: {b: 5e-1, c: +3, d: null}}", {"a": {"b": 0.5, "c": 3, "d": None}}),
        ("[ppo, 'true', true, TRUE, ~]", ["ppo", "true", True, True, None]),
        ("'7'", "7"),
        ("", None),
        ("[&a {p: 1, q: 1}, &b {<<: *a, q: 2}, *b]", [{"p": 1, "q": 1}, *[{"p": 1, "q": 2}] * 2]),
        ("{<<: [{a: 1}, {a: 2, b: 2}, {b: 3, c: 3}], c: 4}", {"a": 1, "b": 2, "c": 4}),
        *((text, text) for text in TEXTS),
        (f"[{', '.join(TEXTS)}]", TEXTS),
    ],
)
def test_a_value_is_what_was_typed(tmp_path: Path, given: str, expected: Any) -> None:
    assert read_options([f"key={given}"]) == {"key": expected}
    (tmp_path / "file.yaml").write_text(f"key: {given}", encoding="utf-8")
    assert read_yaml(tmp_path / "file.yaml") == {"key": expected}


def test_options_go_over_one_another_and_have_no_comments() -> None:
    assert read_options(["a={b: 1, c: 2}", "a={c: 3}"]) == {"a": {"b": 1, "c": 3}}
    assert read_options(["results=a #b"]) == {"results": "a #b"}


def test_labels_have_what_the_figures_font_has() -> None:
    font = FT2Font(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf")
    letters = filter(str.isprintable, map(chr, range(0x20000)))
    taken = [letter for letter in letters if re.fullmatch(LABEL, letter)]
    assert {*"aβ₀$\\%~Ж"} < set(taken) and all(font.get_char_index(ord(one)) for one in taken)
    assert not {"R", "AL"} & set(map(unicodedata.bidirectional, taken))


def test_every_variant_has_a_colour_of_its_own() -> None:
    own = {f"v{place}": {"beta": {"kind": "none"}} for place in range(60)}
    own["v7"] |= {"colour": "#7f7f7f"}  # tab:gray, which is then not another's
    study = load_study(changed({"variants": list(own), "variant_settings": own}), "test")
    colours = list(study.colours.values())
    assert len(set(map(to_hex, colours))) == 60
    assert colours[:2] == ["tab:brown", "tab:pink"]  # those before are others'


HEAVY = {"torch", "numba", "snakemake", "pybullet"}
PLANNED = {"torch", "numba", "pybullet", "pandas", "scipy.stats", "matplotlib.figure", "seaborn"}


@pytest.mark.parametrize(
    ("code", "forbidden", "backend"),
    [
        (None, PLANNED, "of a notebook"),  # whatever of this project the rules import
        ("import mace_study.show.tables", HEAVY | {"gymnasium"}, "agg"),
        ("import mace_study.compare.comparisons", HEAVY | {"gymnasium"}, "agg"),
    ],
)
def test_planning_and_tabulating_import_nothing_slow(code, forbidden, backend) -> None:
    rules = [line for rule in RULES.glob("*.smk") for line in rule.read_text("utf-8").splitlines()]
    planning = [line for line in rules if re.match("(from|import) mace_(rl|study)", line)]
    code = "\n".join([code or "\n".join(planning), "import sys; print(*sys.modules)"])
    command, environ = [sys.executable, "-c", code], os.environ | {"MPLBACKEND": backend}
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "mace_study.config.metrics" in loaded and not loaded & forbidden


def test_a_network_of_mace_full_s_own_leaves_the_published_world_alone():
    own = changed({"variant_settings": {"mace_full": {"meta": {"hidden_units": 48}}}})
    world = read_yaml(ROOT / "config" / "published.yaml")
    studies = [load_study(merge(under, world), "test") for under in (PLAIN, own)]
    plain, other = (study.run_config("CartPole-v1", "mace_full", 0) for study in studies)
    assert plain == other
    assert load_study(own, "test").run_config("CartPole-v1", "mace_full", 0).meta.hidden_units == 48


def test_one_run_of_each_environment_starts_first_then_the_longest():
    given = {"environments": ["CartPole-v1", "Acrobot-v1", "HopperBulletEnv-v0"], "seeds": "3-4"}
    given["environment_settings"] = {"Acrobot-v1": {"episodes": 900}}
    plan = Plan(load_study(changed(given), "test"), ROOT)
    asked = {"ppo": 1, "mace_fixed": 2, "mace_full": 2}  # what a bonus costs
    steps = {"CartPole-v1": 2000 * 500, "Acrobot-v1": 900 * 500, "HopperBulletEnv-v0": 6000 * 1000}
    for env, variant, _ in plan.runs:
        assert plan.work[env, variant] == steps[env] * asked[variant]
    order = sorted(plan.runs, key=lambda run: -plan.priority(*run))
    assert {env for env, *_ in order[:3]} == {*steps} and "ppo" not in {run[1] for run in order[:3]}
    works = [plan.work[run[:2]] for run in order[3:]]
    assert works == sorted(works, reverse=True) and len(works) == 15
