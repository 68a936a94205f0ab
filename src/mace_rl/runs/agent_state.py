"""What `agent.pt` holds of an agent: the state of `mace_rl.runs.agent.Agent`, a torch module."""

from collections import OrderedDict
from typing import Any

import numpy as np
from gymnasium.spaces import Space

from mace_rl.agent.ppo import ActorCritic
from mace_rl.base.state import saved
from mace_rl.numerics.network import CompiledMLP, Network

ENVIRONMENT = "environment"  # the key in agent.pt of what the environment has learned


def agent_state(networks: ActorCritic, space: Space[Any]) -> dict[str, Any]:
    """`Agent(networks, space).state_dict()`; of compiled networks without torch."""
    policy = networks.policy
    if not isinstance(policy.network, CompiledMLP):
        from mace_rl.runs.agent import Agent

        return Agent(networks, space).state_dict()
    state: OrderedDict[str, Any] = OrderedDict()
    parts = ["", "policy"]

    def add(name: str, network: Network) -> None:
        assert isinstance(network, CompiledMLP)  # as the policy's
        layers = network.layers(network.parameters)
        for place, (weights, biases) in enumerate(layers):
            state[f"{name}.{2 * place}.weight"] = saved(weights.T)
            state[f"{name}.{2 * place}.bias"] = saved(biases)
        parts.extend([name, *(f"{name}.{place}" for place in range(2 * len(layers) - 1))])

    if len(policy.log_std):
        state["policy.log_std"] = saved(policy.log_std)
    for name, value in zip(("mean", "std", "clip"), networks.normalisation(), strict=True):
        state[f"policy.{name}"] = saved(np.array(value))
    add("policy.network", policy.network)
    parts.append("critics")
    for kind, critic in networks.critics.items():
        add(f"critics.{kind}", critic)
    versions = OrderedDict((part, {"version": 1}) for part in parts)
    vars(state)["_metadata"] = versions  # as torch's modules note it
    return state
