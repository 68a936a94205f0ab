"""Agents at play before and after training, for the page."""

import base64
import io
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from mace_rl.base import files
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.watch import Film, RenderError, film, gif

WIDTH, SECONDS = 200, 5.0  # a film of Hopper's then takes less than 400 kB


@dataclass(frozen=True)
class Animation:
    """One film as it stands on the page, its pictures as data URIs."""

    title: str
    extrinsic_return: float  # of the whole episode
    moving: str
    still: str  # the last picture, for readers who prefer no motion
    variants: tuple[str, ...]
    trained: bool


def animations(
    runs: Mapping[tuple[str, str], Path],
    labels: Mapping[str, str],
    origin: Path,
    own: Collection[object] = (),
) -> tuple[dict[str, list[Animation]], list[str]]:
    """Films of one run of each environment and variant, and sentences on what there is not.

    `runs` are folders, which the sentences name as seen from `origin`. Variants whose untrained
    agents do the same share that film. Runs may name code from outside this package if their
    configuration is among the reader's `own`.
    """
    missing = []
    without = [folder for folder in runs.values() if not (folder / files.AGENT).exists()]
    if without:
        names = ", ".join(os.path.relpath(folder, origin) for folder in without)
        missing.append(f"Not shown, because {files.AGENT} is not there, are the agents of {names}.")
    folders: dict[str, dict[str, Path]] = {}
    for (environment, variant), folder in runs.items():
        if folder not in without:
            folders.setdefault(environment, {})[variant] = folder
    shown = {}
    for environment, of_variants in folders.items():
        try:
            shown[environment] = _of_one(of_variants, labels, own)
        except RenderError as error:
            missing.append(f"{error}.")
    return shown, missing


def _of_one(
    folders: Mapping[str, Path], labels: Mapping[str, str], own: Collection[object]
) -> list[Animation]:
    """Of one environment: untrained agents first, then the trained ones."""
    untrained: dict[bytes, tuple[Film, list[str]]] = {}
    trained = []
    for variant, folder in folders.items():
        trust = FinishedRun(folder).record["config"] in own
        before = film(folder, untrained=True, trust=trust, width=WIDTH, seconds=SECONDS)
        untrained.setdefault(gif(before), (before, []))[1].append(variant)
        after = film(folder, trust=trust, width=WIDTH, seconds=SECONDS)
        trained.append(_animation(labels[variant], after, gif(after), [variant], True))
    first = []
    for data, (shown, variants) in untrained.items():
        whose = "" if len(untrained) == 1 else ": " + ", ".join(labels[name] for name in variants)
        first.append(_animation(f"Before training{whose}", shown, data, variants, False))
    return [*first, *trained]


def _animation(
    title: str, shown: Film, data: bytes, variants: list[str], trained: bool
) -> Animation:
    still = io.BytesIO()
    shown.pictures[-1].quantize(32).save(still, format="PNG", optimize=True)
    pictures = data_uri("image/gif", data), data_uri("image/png", still.getvalue())
    return Animation(title, shown.returns[0], *pictures, tuple(variants), trained)


def data_uri(kind: str, data: bytes) -> str:
    """Data that stands in the page itself."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
