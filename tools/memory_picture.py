"""Picture what memory says of each state of FrozenLake in the course of a training.

    .venv/bin/python -m tools.memory_picture docs/memory.png

One training with β = 0.4. Beside relevance as it is, relevance by the confirmation's formula, of
the same memory: from the worst to the best return in it.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure

from mace_rl.bonus.curiosity import Curiosity
from mace_rl.study.config import read_study
from mace_rl.study.show.curves import save_figure
from mace_rl.trainer import Trainer

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT, SEED = "FrozenLake8x8Deterministic-v0", 1000
AFTER = (200, 300, 500, 1000)  # episodes
SPAN = 0.1  # of reward: less was no difference to the confirmation's memory


def confirmations(similarity: np.ndarray, recalled: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The confirmation's relevance of N states, whose memory keeps these returns."""
    span = kept.max() - kept.min()
    productivity = np.clip((recalled - kept.min()) / span, 0, 1) if span > SPAN else 0.0
    return 1 - similarity * (1 - productivity)


def grids(curiosity: Curiosity) -> dict[str, Any]:
    """What is pictured of each state, [states]."""
    states = np.eye(len(curiosity.normaliser.mean), dtype=np.float32)
    memory: Any = curiosity.memory
    read = memory.read.copy()
    recalled, similarity = memory.recall(states)
    bonus = curiosity.appraise(states)
    memory.read[:] = read  # nothing was asked: the training goes on as it would
    return {
        "visits, log": np.log10(1 + curiosity.novelty.counts),  # type: ignore[attr-defined]
        "relevance, confirmation": confirmations(
            similarity, recalled, memory.values[: len(memory), -1]
        ),
        "relevance": bonus.relevance,
        "bonus": bonus.reward,
    }


def follow() -> tuple[dict[int, dict[str, np.ndarray]], int]:
    """The grids when each of `AFTER` is reached, and the first episode with a reward, 0: none."""
    files = [ROOT / "config.yaml", ROOT / "config/questions.yaml"]
    config = read_study(files, every_run=False).run_config(ENVIRONMENT, "beta_0.4", SEED)
    trainer = Trainer(config.model_copy(update={"episodes": AFTER[-1]}))
    found: dict[int, dict[str, np.ndarray]] = {}
    first = 0
    for records in trainer.run():
        for record in records:
            first = first or (record.episode if record.extrinsic_return > 0 else 0)
        done = len(trainer.records)
        if any(done - len(records) < after <= done for after in AFTER):
            found[done] = grids(trainer.curiosity)  # type: ignore[arg-type]
    return found, first


def draw(found: dict[int, dict[str, np.ndarray]], first: int) -> Figure:
    """A row for each quantity, a column for each moment, a square for each state."""
    letters = gymnasium.make(ENVIRONMENT).unwrapped.desc.astype(str)  # type: ignore[attr-defined]
    names = list(next(iter(found.values())))
    figure = Figure(figsize=(7.2, 7.6), layout="constrained")
    panels = figure.subplots(len(names), len(found))
    for column, after in enumerate(found):
        for row, name in enumerate(names):
            axes, values = panels[row, column], found[after][name].reshape(letters.shape)
            top = 3.5 if row == 0 else 1
            axes.imshow(values, cmap="viridis", vmin=0, vmax=top)
            axes.set_xticks([])
            axes.set_yticks([])
            for place, letter in np.ndenumerate(letters):
                if letter in "HGS":
                    axes.text(
                        *place[::-1], letter, ha="center", va="center", fontsize=7, color="red"
                    )
            if row == 0:
                axes.set_title(f"after {after} episodes", fontsize=9)
            if column == 0:
                axes.set_ylabel(name, fontsize=9)
    figure.supxlabel(
        f"S start, G goal, H hole. The goal is first met in episode {first}.", fontsize=9
    )
    for row in range(len(names)):
        figure.colorbar(panels[row, -1].images[0], ax=panels[row, :], shrink=0.8)
    return figure


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tools.memory_picture",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("picture", type=Path, help="a PNG file")
    picture = parser.parse_args().picture
    if not picture.parent.is_dir():
        parser.error(f"there is no folder {picture.parent}")
    save_figure(draw(*follow()), picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
