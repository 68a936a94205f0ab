"""β by schedule; what sets it in problems of which it is known what it should do."""

import numpy as np
import pytest
from shared import ROOT, environment_of, finish

from mace_rl.base.rng import Streams
from mace_rl.training.factories import beta_controller
from mace_rl.training.trainer import Trainer
from mace_study.config.study import read_study

HALVED = {"kind": "exponential", "initial": 0.4, "decay": 0.5, "floor": 0.06}
PAPER_S = 0.999 ** np.arange(5000)


@pytest.mark.parametrize(
    ("beta", "expected"),
    [
        ({"kind": "constant", "value": 0.3}, [0.3] * 3),
        (HALVED, [0.4, 0.2, 0.1, 0.06, 0.06]),
        ({"variant": "mace_fixed"}, np.maximum(0.4 * PAPER_S, 0.01)),
        ({"variant": "mace_fixed_0.2"}, np.maximum(0.2 * PAPER_S, 0.01)),
        ({"variant": "mace_fixed_0.6"}, np.maximum(0.6 * PAPER_S, 0.01)),
    ],
)
def test_schedules_by_hand(run_config, beta, expected):
    changes = {"variant": "mace_fixed"} | (beta if "variant" in beta else {"beta": beta})
    config = run_config("CartPole-v1", **changes)
    rule, betas = beta_controller(config, environment_of("CartPole-v1"), Streams(0)), []
    for _ in expected:
        betas.append(rule.next_beta())
        rule.next_episode(None, None)  # whatever it was
    assert betas == pytest.approx(expected) and not rule.learns


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "problem", "low", "high"),
    [
        ("mace_evidence", "Help", 0.6, 1),
        ("mace_evidence", "Harm", 0, 0.1),
        ("mace_evidence", "Nothing", 0.1, 0.6),
        ("mace_pretrained", "Help", 0.6, 1),
        ("mace_pretrained", "Harm", 0, 0.1),
        ("mace_full", "Help", 0.6, 1),
        ("mace_full", "Harm", 0, 0.2),
    ],
)
def test_planted_problems(variant, problem, low, high):
    """A bonus that helps, one that harms, one without any bearing; all starting from β = 0.4."""
    trainer = planted(f"Planted{problem}-v0", variant)
    asked = np.mean([record.beta for record in trainer.records[-80:]])
    if variant == "mace_full":  # without the perturbation that it learns by
        controller = trainer.controller
        asked = 1 / (1 + 1.5 * np.exp(-controller.network.output(controller.sequence)))
    assert low <= asked <= high


@pytest.mark.slow
def test_the_network_reads_which_kind_of_episode_comes_next():
    """In one kind the bonus helps, in the other it harms; they alternate. A sum sees neither."""
    trainer = planted("PlantedMixed-v0", "mace_evidence")
    late = np.array([record.beta for record in trainer.records[-80:]])
    kinds = [late[1::2].mean(), late[0::2].mean()]  # the last episode's first
    helps, harms = kinds if trainer.environment.env.unwrapped.flag == "right" else kinds[::-1]
    assert helps > 0.8 and harms < 0.1
    credit = planted("PlantedMixed-v0", "mace_credit").records[-80:]
    assert np.ptp([record.beta for record in credit]) < 0.2


def planted(environment: str, variant: str) -> Trainer:
    """A training of 800 episodes."""
    over = [ROOT / "config" / f"{name}.yaml" for name in ("tasks", "planted")]
    config = read_study([ROOT / "config.yaml", *over]).run_config(environment, variant, 0)
    return finish(config.model_copy(update={"episodes": 800}))
