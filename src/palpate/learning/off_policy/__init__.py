"""Learning from remembered transitions, in environments side by side."""

from palpate.learning.off_policy.buffer import Motion as Motion
from palpate.learning.off_policy.buffer import Transition as Transition
from palpate.learning.off_policy.constrained import Lagrangian as Lagrangian
from palpate.learning.off_policy.constrained import Penalty as Penalty
from palpate.learning.off_policy.ddpg import (
    DeterministicPolicyGradient as DeterministicPolicyGradient,
)
from palpate.learning.off_policy.loop import OffPolicyTraining as OffPolicyTraining
from palpate.learning.off_policy.loop import train_off_policy as train_off_policy
from palpate.learning.off_policy.recovery import RecoveryAgent as RecoveryAgent
from palpate.learning.off_policy.reflex import ReflexAgent as ReflexAgent
from palpate.learning.off_policy.rollouts import at_its_best as at_its_best
from palpate.learning.off_policy.rollouts import collect as collect
from palpate.learning.off_policy.rollouts import evaluate as evaluate
from palpate.learning.off_policy.sac import SoftActorCritic as SoftActorCritic
from palpate.learning.off_policy.safety_critic import SafetyCritic as SafetyCritic
