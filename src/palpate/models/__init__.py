"""What the robot believes: differentiable dynamics."""

from palpate.models.model import Model as Model
from palpate.models.model import rollout as rollout
