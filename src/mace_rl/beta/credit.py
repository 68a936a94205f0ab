"""The credit of β: what it did to the extrinsic return; and two readings that learn from it.

The update on rollout n moves the policy along P g(β), with g the policy gradient of the total
advantage and P what Adam multiplies by. How the extrinsic return of the policies that result
depends on β is therefore, up to a positive factor (Xu et al. 2018),

    c_n = Σ_k ⟨g_E(θ_{n+k}; rollout n+k), P dg/dβ (θ_n; rollout n)⟩,   k = 1 … horizon.

`docs/method.md` derives it.
"""

import math
from collections import deque

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaGradient
from mace_rl.beta.objectives import Lesson, Objective, Played, evenly
from mace_rl.beta.squash import natural_log
from mace_rl.config.beta import CreditConfig, EvidenceObjective
from mace_rl.numerics.matmul import dot

SIZE_DECAY = 0.99  # of the running mean that says how large outputs usually are, per credit
SCALE_DECAY = 0.99  # of the running mean that says how large alignments usually are, per update


class Judge(Stateful):
    """Credits the β of each rollout by the next `horizon` updates.

    Each term is in units of its usual size, with both vectors per unit of advantage, and counts as
    much as there is of extrinsic and of intrinsic advantage: where nothing is left to learn, or the
    bonus weighs nothing, there is no signal.
    """

    STATE = ("directions", "bonus_weights", "credits", "alignments", "alignment_weight")

    def __init__(self, config: CreditConfig) -> None:
        self.horizon, self.bound = config.horizon, config.max_credit
        # Of each β that is being judged, the oldest first:
        self.directions: list[np.ndarray] = []  # what it changes in the policy, of length 1, or 0
        self.bonus_weights: list[float] = []  # RMS(A_I) in that update, at most 1
        self.credits: list[float] = []
        self.alignments, self.alignment_weight = 0.0, 0.0  # running sum of squares, of weights

    def judge(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> float | None:
        """The credit of the β that has now been judged to the end; arguments as in `learn`."""
        self.credit_all(gradient, advantage_rms)
        judged = len(self.credits) == self.horizon
        credit = self.bounded(self.credits[0]) if judged else None
        length = math.sqrt(dot(change.direction, change.direction))
        direction = change.direction / np.float32(length) if length > 0 else change.direction
        self.directions = [*self.directions[judged:], direction]
        self.bonus_weights = [*self.bonus_weights[judged:], min(1.0, change.advantage_rms)]
        self.credits = [*self.credits[judged:], 0.0]
        return credit

    def credit_all(self, gradient: np.ndarray, advantage_rms: float) -> None:
        """Add one term to the credit of every β under judgement, in units of its usual size.

        That is a running root mean square, in which each update counts as one.
        """
        if not (self.credits and advantage_rms > 0):
            return
        along = [dot(gradient, direction) / advantage_rms for direction in self.directions]
        squares = sum(value * value for value in along) / len(along)
        self.alignments = SCALE_DECAY * self.alignments + squares
        self.alignment_weight = SCALE_DECAY * self.alignment_weight + 1
        rms = math.sqrt(self.alignments / self.alignment_weight)
        if rms > 0:
            terms = zip(along, self.bonus_weights, strict=True)
            added = [value / rms * min(1.0, advantage_rms) * weight for value, weight in terms]
            self.credits = [a + b for a, b in zip(self.credits, added, strict=True)]

    def bounded(self, credit: float) -> float:
        """A sum of `horizon` terms as one whose noise has size 1, within `max_credit`."""
        return min(max(credit / math.sqrt(self.horizon), -self.bound), self.bound)


class Credit(Objective):
    """L = −c o: the credit c of β, a meta-gradient of the extrinsic return (Xu et al. 2018).

    c is what a little more of β in a rollout did to it. The network learns from all episodes of the
    rollout, at most `sequences`.
    """

    STATE: tuple[str, ...] = ("judge", "played", "judged")

    asks_policy = True

    def __init__(self, config: CreditConfig, sequences: int) -> None:
        self.judge, self.most = Judge(config), sequences
        self.played: list[tuple[np.ndarray, float]] = []  # since the last update: read, output
        # Of each rollout whose β is being judged, the oldest first: what was read, mean output.
        self.judged: deque[tuple[list[np.ndarray], float]] = deque()

    def after_episode(self, played: Played) -> None:
        self.played.append((played.sequence, played.output))

    def after_rollout(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> tuple[float | None, Lesson | None]:
        credit = self.judge.judge(gradient, advantage_rms, change)
        chosen = evenly(self.played, self.most)
        mean_output = sum(output for _, output in chosen) / max(len(chosen), 1)
        self.judged.append(([sequence for sequence, _ in chosen], mean_output))
        self.played = []
        if credit is None:
            return None, None
        sequences, output = self.judged.popleft()
        if not sequences:  # the first episode's β was given
            return credit, None
        self.credited(credit, output)
        return credit, Lesson(sequences, -credit)

    def credited(self, credit: float, output: float) -> None:
        """A credit has come for the output that set its β."""


class Evidence(Credit):
    """The same, but β waits for evidence that outputs had the right sign before their credits came.

    S = Σ c u, with u the output in units of its usual size, at most 1. Each u is known before its
    c, so S has mean 0 if β changes nothing, whatever the network has learned from noise. Its
    variance is V = Σ (c u)². Only what is beyond Robbins' bound (1970) moves β: chance crosses that
    in a given share of all trainings, however long they are.
    """

    STATE = (*Credit.STATE, "sum", "variance", "size", "weight")

    def __init__(self, config: EvidenceObjective, sequences: int) -> None:
        super().__init__(config, sequences)
        self.config = config
        self.sum, self.variance = 0.0, 0.0
        self.size, self.weight = 0.0, 0.0  # running sum of o², and of the weights in it

    def unit(self, output: float) -> float:
        """u; NaN stays NaN."""
        if not self.size:
            return 0.0 * output
        return min(max(output / math.sqrt(self.size / self.weight), -1.0), 1.0)

    def credited(self, credit: float, output: float) -> None:
        term = credit * self.unit(output)
        self.sum += term
        self.variance += term**2
        self.size = SIZE_DECAY * self.size + output**2
        self.weight = SIZE_DECAY * self.weight + 1

    @property
    def beyond_chance(self) -> float:
        """How far S is beyond the bound, in standard deviations; 0 if it is not.

        The bound is √((V + ρ) (2 ln 1/α + ln (V + ρ)/ρ)): S crosses it, above or below, with
        probability α at most.
        """
        known, chance = self.variance + self.config.scale, self.config.chance
        bound = 2 * natural_log(1 / chance) + natural_log(known / self.config.scale)
        return max(self.sum / math.sqrt(known) - math.sqrt(bound), 0.0)

    def logit(self, output: float) -> float:
        return self.config.gain * self.beyond_chance * self.unit(output)
