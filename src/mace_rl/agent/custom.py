"""A network of the user's own."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from mace_rl.config.agent import TorchModule
from mace_rl.config.plugins import make, noted
from mace_rl.config.section import ConfigError


def custom_module(
    settings: TorchModule,
    hidden_units: list[int],
    inputs: int,
    outputs: int,
    generator: np.random.Generator,
) -> torch.nn.Module:
    """The user's own module; `generator` seeds torch's global one while it is made.

    Raises `ConfigError` if it has buffers, or outputs that are not [N, outputs] or not the same
    twice: the run would not resume to the bit.
    """
    with torch.random.fork_rng(devices=[]), as_torch_begins():
        torch.manual_seed(int(generator.integers(2**63)))
        key, name, arguments = "ppo.network.module", settings.module, settings.arguments
        kind = torch.nn.Module
        module = make(name, key, kind, True, inputs, outputs, hidden_units, **arguments).float()
        trial = torch.randn(2, inputs)  # not 0, which a dropout before any bias would keep
        with noted(f"a trial of {name!r}"):
            first, second = module(trial), module(trial)
            shapes, same = [tuple(first.shape), (2, outputs)], torch.equal(first, second)
        learns = {parameter.requires_grad for parameter in module.parameters()} == {True}
    for problem, found in {
        f"gives {shapes[0]} for inputs (2, {inputs}), not {shapes[1]}": shapes[0] != shapes[1],
        "has parameters that do not learn, or none": not learns,
        "keeps state besides its parameters (buffers)": any(True for _ in module.buffers()),
        "gives other outputs the second time (dropout?)": not same,
    }.items():
        if found:
            raise ConfigError(f"{key}: the module of {settings.module!r} {problem}")
    return module


@contextmanager
def as_torch_begins() -> Iterator[None]:
    """New tensors are float32 on the CPU, whatever defaults the program has set."""
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(dtype)
