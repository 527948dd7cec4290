"""Learning from remembered transitions, in environments side by side."""

from palpate.learning.off_policy.buffer import Transition as Transition
from palpate.learning.off_policy.loop import OffPolicyTraining as OffPolicyTraining
from palpate.learning.off_policy.loop import train_off_policy as train_off_policy
from palpate.learning.off_policy.sac import SoftActorCritic as SoftActorCritic
