"""What the robot believes: differentiable dynamics."""

from palpate.models.model import Model as Model
from palpate.models.model import rollout as rollout
from palpate.models.rope import Rope as Rope
from palpate.models.rope import RopeState as RopeState
