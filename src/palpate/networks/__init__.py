"""Controllers and the networks among them: they know arrays, units and limits, and no task."""

from palpate.networks.channels import Channel as Channel
from palpate.networks.channels import count_of as count_of
from palpate.networks.controller import Controller as Controller
from palpate.networks.controller import DeclaredController as DeclaredController
from palpate.networks.controller import load_controller as load_controller
from palpate.networks.controller import save_controller as save_controller
from palpate.networks.guarded import ActorPolicy as ActorPolicy
from palpate.networks.guarded import Guard as Guard
from palpate.networks.guarded import GuardedPolicy as GuardedPolicy
from palpate.networks.policy import CommandPolicy as CommandPolicy
from palpate.networks.policy import load_policy as load_policy
