"""The credit of β: what it did to the extrinsic return, update by update, and what that adds up to.

The update on rollout n moves the policy along P g(β), with g the policy gradient of the total
advantage and P what Adam multiplies by. How the extrinsic return of the policies that result
depends on β is therefore, up to a positive factor (Xu et al. 2018),

    c_n = Σ_k ⟨g_E(θ_{n+k}; rollout n+k), P dg/dβ (θ_n; rollout n)⟩,   k = 1 … horizon.

`docs/method.md` derives it.
"""

import math

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaGradient
from mace_rl.config.beta import CreditConfig, PretrainedConfig
from mace_rl.numerics.matmul import dot

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
            added = [value / rms * min(1.0, advantage_rms) * own for value, own in terms]
            self.credits = [a + b for a, b in zip(self.credits, added, strict=True)]

    def bounded(self, credit: float) -> float:
        """A sum of `horizon` terms as one whose noise has size 1, within `max_credit`."""
        return min(max(credit / math.sqrt(self.horizon), -self.bound), self.bound)


class Integrator(Stateful):
    """Adds up n credits c, and moves β's logit once they say more than chance would.

    z = Σc / √max(Σc², N / 2) is the sum in units of its noise, N the number of credits that the
    whole training will have. At the end it is about standard normal if β changed nothing; earlier
    it is smaller, so that β does not wander. Below the threshold the logit stays; beyond it
    follows z.
    """

    STATE = ("count", "expected", "sum", "squares")

    def __init__(self, config: PretrainedConfig) -> None:
        self.gain, self.threshold = config.credit_gain, config.credit_threshold
        self.count, self.expected, self.sum, self.squares = 0, 0.0, 0.0, 0.0

    def add(self, credit: float, progress: float) -> None:
        """Take in one more credit; progress: the share of the training that is over, above 0."""
        self.count += 1
        self.expected = self.count / progress
        self.sum += credit
        self.squares += credit * credit

    @property
    def logit(self) -> float:
        """What the credits add to the logit of β."""
        if self.count == 0:
            return 0.0
        z = self.sum / math.sqrt(max(self.squares, self.expected / 2))
        return math.copysign(self.gain * max(abs(z) - self.threshold, 0.0), z)
