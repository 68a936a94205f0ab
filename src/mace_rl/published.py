"""What the authors' public code computes, as far as it could be read: `trainer: published`.

    R_total = r + β · min(1, novelty · relevance) · |r|          (0.1 for |r| where r is 0)

docs/deviations.md says what was read and where it departs from the paper's text; `config.published`
names each departure, and what its other value does is here, too.

Random numbers come from the run's own streams, and the environment is seeded, which the public code
does not do: there a seed does not fix a run. Left out is what changes nothing: the values in
memory, decay of counts by a clock that stands still, an optimiser that no gradient reaches.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Discrete
from torch import Tensor, from_numpy, nn

from mace_rl.agent.advantages import discounted_returns
from mace_rl.agent.learner import Update
from mace_rl.agent.policy import Policy
from mace_rl.agent.ppo import ActorCritic, Evaluation
from mace_rl.agent.torch_learner import TorchLearner
from mace_rl.agent.torch_policy import TorchPolicy
from mace_rl.base.rng import Streams
from mace_rl.base.state import Stateful
from mace_rl.bonus.intrinsic import Bonus
from mace_rl.config.beta import MetaBeta
from mace_rl.config.published import PublishedConfig
from mace_rl.config.run import AgentConfig
from mace_rl.config.section import ConfigError
from mace_rl.environments.environment import Environment
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.finite import require_finite
from mace_rl.numerics.normaliser import RunningNormaliser
from mace_rl.numerics.torch_network import TorchNetwork
from mace_rl.training.experience import Experience, Rollout, without_bonus
from mace_rl.training.rollout import roll_out
from mace_rl.training.trainer import Trainer

CAPACITY = 1000  # of the memory
NEIGHBOURS, BUFFER_SIZE, KNN_WEIGHT = (10, 15, 20), 20_000, 0.7  # of novelty by distance
SCHEDULE_EVERY = 10  # episodes for which a β that decays stays the same


@contextmanager
def drawing_from(generator: np.random.Generator) -> Iterator[None]:
    """What torch draws in this block comes from `generator`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(generator.integers(2**63)))
        yield


def layer(before: int, after: int, dropout: float) -> list[nn.Module]:
    """What every network here is made of."""
    return [nn.Linear(before, after), nn.LayerNorm(after), nn.ReLU(), nn.Dropout(dropout)]


class Actor(nn.Module):
    """[N, inputs] → logits or means, [N, outputs]."""

    def __init__(self, inputs: int, outputs: int, units: list[int], dropout: bool = True) -> None:
        super().__init__()
        first, second, third, last = units
        layers = [*layer(inputs, first, 0.15 * dropout), *layer(first, second, 0.1 * dropout)]
        self.backbone = nn.Sequential(*layers, *layer(second, third, 0.0))
        self.around = nn.Linear(inputs, third)
        self.head = nn.Sequential(nn.Linear(third, last), nn.Tanh(), nn.Linear(last, outputs))

    def forward(self, observations: Tensor) -> Tensor:
        return self.head(self.backbone(observations) + self.around(observations))


class Critic(Actor):
    """[N, inputs] → values, [N, 1]. A state attends to a sequence of one: itself."""

    def __init__(self, inputs: int, units: list[int], dropout: bool) -> None:
        super().__init__(inputs, 1, units, dropout)
        self.attention = nn.MultiheadAttention(units[-2], 8, 0.1 * dropout, batch_first=True)

    def forward(self, observations: Tensor) -> Tensor:
        features = (self.backbone(observations) + self.around(observations))[:, None]
        return self.head(self.attention(features, features, features)[0][:, 0])


class PublishedMetaNetwork(nn.Module):
    """An episode's steps, [1, T, inputs] → [1, 1], of which β is the logistic function."""

    def __init__(self, inputs: int, dropout: bool) -> None:
        super().__init__()
        units, little, more = 128, 0.1 * dropout, 0.15 * dropout
        self.begin = nn.Sequential(*layer(inputs, units, little))
        self.lstm = nn.LSTM(units, units, 3, batch_first=True, dropout=more, bidirectional=True)
        attention = [
            nn.MultiheadAttention(2 * units, 8, little, batch_first=True) for _ in range(2)
        ]
        self.attention = nn.ModuleList(attention)
        self.norms = nn.ModuleList(nn.LayerNorm(2 * units) for _ in attention)
        ends = [*layer(2 * units, units, more), *layer(units, units // 2, 0.0)]
        self.end = nn.Sequential(*ends, nn.Linear(units // 2, 1))

    def forward(self, steps: Tensor) -> Tensor:
        seen = self.lstm(self.begin(steps))[0]
        for attention, norm in zip(self.attention, self.norms, strict=True):
            seen = norm(seen + attention(seen, seen, seen)[0])
        return self.end((seen * seen.mean(-1).softmax(1)[..., None]).sum(1))


class PublishedCuriosity(Stateful):
    """The bonus of each step, for the state before it, and the raw states that it rests on."""

    STATE = ("keys", "usage", "size", "buffer", "entered")

    def __init__(self, settings: PublishedConfig, spaces: Spaces) -> None:
        self.settings, width = settings, spaces.observation_size
        self.keys = np.zeros((CAPACITY, width), np.float32)  # the memory ...
        self.usage = np.zeros(CAPACITY, np.int64)  # ... and how often each of it was the nearest
        self.size = self.entered = 0
        by_actions = settings.counts_by_action_space
        space = spaces.action_space if by_actions else spaces.observation_space
        self.counts, self.visits = isinstance(space, Discrete), dict[bytes, int]()
        self.fills = settings.novelty_buffer_fills and not self.counts
        self.buffer = np.zeros((BUFFER_SIZE * self.fills, width), np.float32)

    def bonus(self, episode: Episode) -> Bonus:
        """What β weighs; the states are remembered on the way."""
        parts = np.empty((2, len(episode)))
        for t, state in enumerate(episode.observations[:-1]):
            parts[:, t] = self.novelty(state), self.relevance(state)
            self.remember(state)
        reward = parts[0] * parts[1]
        if self.settings.bonus_at_most_one:
            reward = np.minimum(reward, 1.0)
        if self.settings.bonus_times_reward:
            reward *= np.where(episode.rewards == 0, 0.1, abs(episode.rewards))
        return Bonus(reward, *parts)

    def novelty(self, state: np.ndarray) -> float:
        """1 / (n + 1), n visits to exactly this state, this one included; or by distances.

        Only a buffer that has a state takes one, so it stays empty and novelty 1, unless it
        `fills`. The public code then adds what an untrained network says, which is about 1/2.
        """
        if self.counts:
            count = self.visits[state.tobytes()] = self.visits.get(state.tobytes(), 0) + 1
            return 1 / (count + 1)
        if not self.fills:
            return 1.0
        known = self.buffer[: self.entered] - state
        self.buffer[self.entered % BUFFER_SIZE] = state
        self.entered += 1
        if not len(known):
            return 1.0
        distances = np.sqrt(np.sort(np.square(known).sum(1)))
        means = [float(distances[:k].mean()) for k in NEIGHBOURS if k <= len(known)]
        return KNN_WEIGHT * sum(means) / len(NEIGHBOURS) + (1 - KNN_WEIGHT) / 2

    def relevance(self, state: np.ndarray) -> float:
        """By the distance to the nearest key; 1 while there is none."""
        if not self.size:
            return 1.0
        squares = np.square(self.keys[: self.size] - state).sum(1)
        nearest = squares.argmin()
        self.usage[nearest] += 1
        distance = float(np.sqrt(squares[nearest]))
        pays = self.settings.near_memory_pays
        return 1 / (distance + 1e-6) if pays else distance / (1 + distance)

    def remember(self, state: np.ndarray) -> None:
        """Where there is room, else in place of the least used; and then once more there."""
        filling = self.size < CAPACITY
        place = self.size if filling else self.usage.argmin()
        self.keys[place], self.usage[place] = state, 1
        self.size += filling
        if self.settings.memory_stores_twice:
            place = self.usage.argmin()
            self.keys[place], self.usage[place] = state, self.usage.max() + 1

    def state_dict(self) -> dict[str, Any]:
        states = np.frombuffer(bytearray().join(self.visits), np.float32)
        counts = torch.tensor(list(self.visits.values()), dtype=torch.int64)
        return super().state_dict() | {"visited": from_numpy(states), "counts": counts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        visited = state["visited"].numpy().reshape(-1, self.keys.shape[1])
        counts = state["counts"].tolist()
        self.visits = {one.tobytes(): n for one, n in zip(visited, counts, strict=True)}


class PublishedMeta(Stateful):
    """The meta network and the β that it printed last, which usually reaches nothing."""

    STATE = ("printed", "draws")

    def __init__(self, spaces: Spaces, dropout: bool, draws: np.random.Generator) -> None:
        self.printed, self.draws, self.actions = 0.0, draws, spaces.actions.width
        with drawing_from(draws):
            self.network = PublishedMetaNetwork(spaces.observation_size + self.actions + 2, dropout)

    def read(self, episode: Episode, bonus: np.ndarray) -> None:
        """An episode and, or zeros in its place, its bonus, [T]."""
        actions = episode.actions
        actions = np.eye(self.actions)[actions] if actions.ndim == 1 else actions
        steps = np.column_stack([episode.observations[:-1], actions, episode.rewards, bonus])
        with drawing_from(self.draws), torch.no_grad():
            output = self.network(from_numpy(steps.astype(np.float32))[None])
        self.printed = output.sigmoid().item()


def networks(config: AgentConfig, spaces: Spaces, streams: Streams) -> ActorCritic:
    """Policy and critic, as training begins with them."""
    assert config.published is not None
    settings, size, dropout = config.ppo, spaces.observation_size, config.published.dropout
    with drawing_from(streams["actor"]):
        actor = Actor(size, spaces.action_size, settings.hidden_units, dropout)
    with drawing_from(streams["extrinsic_critic"]):
        critics = {"extrinsic": TorchNetwork(Critic(size, settings.hidden_units, dropout))}
    policy = Policy(TorchNetwork(actor), spaces.actions, settings.initial_log_std)
    return ActorCritic(settings, policy, critics, RunningNormaliser(size), TorchLearner)


class PublishedPPO(ActorCritic, Stateful):
    """One update per episode, on all of it: like nikhilbarhate99/PPO-PyTorch's up to d5c8837."""

    STATE = ("actor", "critic", "optimiser", "draws")

    def __init__(self, made: ActorCritic, draws: np.random.Generator) -> None:
        super().__init__(**vars(made))
        self.draws = draws  # of dropout
        self.actor, self.critic = made.policy.network.module(), made.critics["extrinsic"].module()
        self.pi = TorchPolicy(made.policy, validate=False)  # NaN is found in the weights
        rates = self.config.actor_learning_rate, self.config.critic_learning_rate
        pairs = zip((self.actor, self.critic), rates, strict=True)
        groups = [{"params": network.parameters(), "lr": rate} for network, rate in pairs]
        self.optimiser = torch.optim.Adam(groups, fused=True)  # a quarter of the time

    def update(self, episode: Episode, returns: np.ndarray) -> tuple[Update, np.ndarray]:
        """K epochs on an episode; returns also what the critic said before, float32 [T]."""
        seen, targets = from_numpy(episode.observations[:-1]), from_numpy(returns)
        epsilon, said = self.config.clip, []
        for _ in range(self.config.epochs):
            policy, values = self.pi(seen), self.critic(seen)[:, 0]
            said.append(values.detach())
            advantages = targets - said[-1]
            log_probs = policy.log_prob(from_numpy(episode.actions))
            log_ratio = log_probs - from_numpy(episode.log_probs)
            ratio = log_ratio.exp()
            clipped = ratio.clip(1 - epsilon, 1 + epsilon)
            surrogate = torch.min(ratio * advantages, clipped * advantages).mean()
            entropy = policy.entropy().mean()
            loss = 0.5 * (values - targets).square().mean() - surrogate
            loss = loss - self.config.entropy_coefficient * entropy
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
        norms = {
            name: torch.nn.utils.get_total_norm([part.grad for part in group["params"]]).item()
            for name, group in zip(("actor", "extrinsic"), self.optimiser.param_groups, strict=True)
        }
        outside = ((ratio - 1).abs() > epsilon).float()
        means = (part.mean().item() for part in (ratio - 1 - log_ratio, outside, entropy))
        return Update(norms, *means), said[0].numpy()


class PublishedTrainer(Trainer):
    """One run of the public code; see `Trainer`, whose rounds and records it has."""

    ppo: Any
    curiosity: Any
    controller: Any

    def _make_parts(self, streams: Streams) -> None:
        config, environment = self.config, self.environment
        assert config.published is not None
        # Not before: a variant of config.yaml that is not asked for may have one of these.
        if isinstance(config.beta, MetaBeta) and config.beta.objective:
            reason = f"{config.beta.objective.kind!r}, which trainer: published does not know"
            raise ConfigError(f"beta.objective is {reason}")
        self.settings, bonus = config.published, config.beta.kind != "none"
        self.curiosity = PublishedCuriosity(config.published, environment) if bonus else None
        dropout = config.published.dropout
        self.controller = PublishedMeta(environment, dropout, streams["meta"]) if bonus else None
        self.ppo = PublishedPPO(networks(config, environment, streams), streams["dropout"])
        self.play = self._play

    def _play(self, environment: Environment, policy: Any, noise: np.ndarray) -> Episode:
        with drawing_from(self.ppo.draws), torch.inference_mode():
            return roll_out(environment, policy, noise)

    def _beta(self) -> float:
        """Of a schedule that is set after the first episode and each tenth on, or the first."""
        rule, done = self.config.beta, len(self.records)
        if rule.kind == "constant":
            return rule.value
        if rule.kind == "exponential":
            age = max(0, done - 1) // SCHEDULE_EVERY * SCHEDULE_EVERY
            return max(rule.floor, rule.initial * rule.decay**age)
        assert isinstance(rule, MetaBeta)  # others are refused
        reaches = self.settings.beta_reaches_reward and done
        return self.controller.printed if reaches else rule.initial

    def advantages(self, episode: Episode) -> Experience:
        """The returns of the total reward; what is returned has the β that the network printed."""
        bonus, beta, printed, reward = None, 0.0, 0.0, np.zeros(len(episode))
        if self.curiosity is not None:
            bonus, beta = self.curiosity.bonus(episode), self._beta()
            printed, reward = beta, bonus.reward
            if self.config.beta.kind == "meta":
                self.controller.read(episode, reward * self.settings.meta_sees_bonus)
                printed = self.controller.printed
        self.record(episode, bonus, beta)
        returns = discounted_returns(episode.rewards + beta * reward, self.config.ppo.discount)
        both = Evaluation(returns, returns, 1.0)
        # How the two rewards share in what one critic learns is unknown.
        none = without_bonus(len(episode))._replace(scale=np.nan)
        return Experience(episode, episode.observations[:-1], printed, bonus, both, none)

    def meta_update(self, rollout: Rollout) -> None:
        """The meta network's loss is a number on its own: nothing is learned."""

    def ppo_update(self, rollout: Rollout) -> Update:
        """PPO on the total reward of one episode."""
        [item] = rollout
        returns = item.extrinsic.returns.astype(np.float32)
        with drawing_from(self.ppo.draws):
            update, values = self.ppo.update(item.episode, returns)
        for name, network in (("actor", self.ppo.policy), *self.ppo.critics.items()):
            require_finite(f"a weight of the {name}", network.parameters)
        evaluation = item.extrinsic._replace(advantages=item.extrinsic.returns - values)
        rollout[0] = replace(item, extrinsic=evaluation)
        return update
