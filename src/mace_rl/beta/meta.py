"""β from the meta-adaptation network, an LSTM that is trained on what β did (paper, supplement)."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from mace_rl.beta.controller import BetaController, Effect
from mace_rl.beta.lstm import CompiledMetaNetwork, MetaNetwork, logit
from mace_rl.beta.progress import Progress
from mace_rl.config.beta import MetaConfig
from mace_rl.environments.rollout import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.adam import Adam
from mace_rl.numerics.arrays import total
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import exp, log
from mace_rl.numerics.normaliser import RunningNormaliser
from mace_rl.numerics.products import dot
from mace_rl.state import Stateful, restored, saved

STATE_CLIP = 10.0  # bound of what the LSTM reads of a state, in standard deviations
SCALE_DECAY = 0.99  # of the running mean that says how large alignments usually are, per update


@dataclass
class PendingCredit:
    """The β of one episode, while the updates that follow tell what it did."""

    inputs: np.ndarray | None  # what the LSTM read for it; None for the first, which is given
    direction: np.ndarray  # what it changes in the policy, of length 1, or 0
    strength: float  # of the bonus in that update, at most 1
    credit: float = 0.0
    updates: int = 0  # that judged it so far


class MetaAdaptation(Stateful, BetaController):
    """β from an LSTM trained on what helped the extrinsic return (paper; Xu et al. 2018).

    The update on rollout n moves the policy along P g(β_n), with g the policy gradient of the total
    advantage and P what Adam multiplies by. How the extrinsic return of the policies that result
    depends on β_n is therefore, up to a positive factor,

        c_n = Σ_k ⟨g_E(θ_{n+k}; rollout n+k), P dg/dβ_n (θ_n; rollout n)⟩,   k = 1 … horizon.

    Each term is measured in units of its usual size, with both vectors per unit of advantage, and
    counts as much as there is of extrinsic and of intrinsic advantage: where nothing is left to
    learn, or β weighs nothing, there is no signal. By the chain rule through β_n's logit it trains
    the LSTM, with a pull to the logit of the initial β. `docs/method.md` derives it.
    """

    STATE = (
        *("optimiser", "normaliser", "progress", "inputs", "training_batch"),
        *("alignments", "alignment_weight"),
    )

    def __init__(
        self,
        config: MetaConfig,
        initial: float,
        spaces: Spaces,
        generator: np.random.Generator,
    ) -> None:
        self.config = config
        self.initial = initial
        self.learns = config.learning_rate > 0
        self.action_size = spaces.action_size
        inputs = spaces.observation_size + spaces.action_size + 2 + Progress.SIZE
        module = MetaNetwork(inputs, config.hidden_units, initial, generator)
        self.network = CompiledMetaNetwork(module)
        self.optimiser = Adam(
            self.network.parameters, config.learning_rate, config.max_gradient_norm
        )
        self.normaliser = RunningNormaliser(spaces.observation_size)
        self.progress = Progress()
        # What the LSTM read for the β of each episode since the last `learn`, and for that of the
        # next; None for the first episode.
        self.inputs: deque[np.ndarray | None] = deque([None])
        self.next_beta: float | None = None  # β of the next episode, once somebody has asked
        self.pending: list[PendingCredit] = []
        self.training_batch: list[tuple[np.ndarray, float]] = []  # what was read, and its credit
        self.alignments, self.alignment_weight = 0.0, 0.0  # running sum of squares, of weights

    @property
    def beta(self) -> float:
        """See `BetaController`; from the network as it is now."""
        if self.next_beta is None:
            read = self.inputs[-1]
            trace = None if read is None else self.network.forward([read])
            self.next_beta = self.initial if trace is None else beta_of(trace.outputs[0])
        return self.next_beta

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        beta = self.beta
        self.normaliser.update(episode.observations[:-1])
        self.progress.update(total(episode.rewards))
        if not self.learns:  # nobody will ask what the earlier ones were
            self.inputs.clear()
        self.inputs.append(self.sequence(episode, bonus, beta))
        self.next_beta = None

    def sequence(self, episode: Episode, bonus: np.ndarray, beta: float) -> np.ndarray:
        """What the LSTM reads of an episode: state, action, extrinsic reward and curiosity bonus.

        Beside them, at every step, how training goes (`Progress`). float32 [min(T, max_sequence),
        input]. Longer episodes are cut into equal stretches: mean state and action, and the sums of
        reward and bonus, as sign(x) log(1 + |x|), so that the return can be read off and rewards of
        any size fit.
        """
        actions = episode.actions
        if actions.ndim == 1:
            actions = np.eye(self.action_size, dtype=np.float32)[actions]
        states = self.normaliser(episode.observations[:-1], STATE_CLIP)
        length = min(self.config.max_sequence or len(episode), len(episode))
        features = self.progress.features(beta)
        return stretches(states, actions, episode.rewards, bonus, features, length)

    def learn(self, gradient: np.ndarray, strength: float, effects: list[Effect]) -> float | None:
        """See `BetaController`: judge the βs of the last updates, then remember this one's."""
        self.credit_all(gradient, strength)
        done = [item for item in self.pending if item.updates == self.config.horizon]
        self.pending = self.pending[len(done) :]
        self.pending += [self.judge(self.inputs.popleft(), effect) for effect in effects]
        for item in done:
            if item.inputs is not None:
                self.training_batch.append((item.inputs, self.bounded(item.credit)))
        if len(self.training_batch) < self.config.learn_every:
            return None
        inputs, credits = zip(*self.training_batch, strict=True)
        # Adam descends, so what it gets is minus the mean.
        self.optimiser.step(-self.logit_gradient(list(inputs), np.array(credits)))
        self.training_batch, self.next_beta = [], None
        return sum(credits) / len(credits)

    def judge(self, inputs: np.ndarray | None, effect: Effect) -> PendingCredit:
        """The β that the LSTM set when it read `inputs` and that had this effect."""
        length = math.sqrt(dot(effect.direction, effect.direction))
        direction = effect.direction / np.float32(length) if length > 0 else effect.direction
        return PendingCredit(inputs, direction, min(1.0, effect.advantage_rms))

    def credit_all(self, gradient: np.ndarray, strength: float) -> None:
        """Add one term to the credit of every β under judgement, in units of its usual size.

        That is a running root mean square, in which each update counts as one.
        """
        for item in self.pending:
            item.updates += 1
        if not (self.pending and strength > 0):
            return
        along = [dot(gradient, item.direction) / strength for item in self.pending]
        squares = sum(value * value for value in along) / len(along)
        self.alignments = SCALE_DECAY * self.alignments + squares
        self.alignment_weight = SCALE_DECAY * self.alignment_weight + 1
        usual = math.sqrt(self.alignments / self.alignment_weight)
        if usual > 0:
            for item, value in zip(self.pending, along, strict=True):
                item.credit += value / usual * min(1.0, strength) * item.strength

    def bounded(self, credit: float) -> float:
        """A sum of `horizon` terms as one whose noise has size 1, within `max_credit`."""
        bound = self.config.max_credit
        return min(max(credit / math.sqrt(self.config.horizon), -bound), bound)

    def logit_gradient(self, inputs: list[np.ndarray], credits: np.ndarray) -> np.ndarray:
        """Mean of (credit - prior · (logit - initial logit)) · dlogit/dφ over B β, float32 [n].

        By the logit and not by β, whose derivative β (1 - β) would hold a β near 0 or 1 for ever.
        inputs: of each β, float32 [T, input]; credits: [B]; φ are the parameters, [n].
        """
        trace = self.network.forward(inputs)
        steps = credits - self.config.prior * (trace.outputs - logit(self.initial))
        return self.network.backward(trace, (steps / len(inputs)).astype(np.float32))

    def state_dict(self) -> dict[str, Any]:
        """See `Stateful`."""
        return super().state_dict() | {"pending": [saved(vars(item)) for item in self.pending]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Stateful`."""
        super().load_state_dict(state)
        self.pending = [PendingCredit(**restored(None, item)) for item in state["pending"]]
        self.next_beta = None


@kernel
def beta_of(logit: np.float32) -> float:
    """1 / (1 + e⁻ˣ), float64, which is below 1 as long as the logit x is below 36."""
    return 1 / (1 + np.float64(exp(-logit)))


@kernel
def stretches(
    states: np.ndarray,
    actions: np.ndarray,
    rewards: np.ndarray,
    bonus: np.ndarray,
    training: np.ndarray,
    length: int,
) -> np.ndarray:
    """`MetaAdaptation.sequence` from its parts, [T, …] each but training, in `length` stretches."""
    seen = states.shape[1] + actions.shape[1]
    result = np.zeros((length, seen + 2 + len(training)), np.float32)
    for k in range(length):
        first, end = k * len(states) // length, (k + 1) * len(states) // length
        row, reward, novelty = result[k], 0.0, 0.0
        for t in range(first, end):
            for i in range(states.shape[1]):
                row[i] += states[t, i]
            for i in range(actions.shape[1]):
                row[states.shape[1] + i] += actions[t, i]
            reward += rewards[t]
            novelty += bonus[t]
        for i in range(seen):
            row[i] /= np.float32(end - first)
        row[seen], row[seen + 1] = logarithm(reward), logarithm(novelty)
        row[seen + 2 :] = training
    return result


@kernel
def logarithm(x: float) -> np.float32:
    """sign(x) log(1 + |x|)."""
    size = log(np.float32(1 + abs(x)))
    return -size if x < 0 else size
