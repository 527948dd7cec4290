"""Networks that act: they know arrays, units and limits, and no task."""

from palpate.networks.policy import CommandPolicy as CommandPolicy
from palpate.networks.policy import Policy as Policy
from palpate.networks.policy import load_policy as load_policy
from palpate.networks.policy import save_policy as save_policy
