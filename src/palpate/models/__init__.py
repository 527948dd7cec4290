"""What the robot believes: differentiable dynamics."""

from palpate.models.model import Model as Model
from palpate.models.model import rollout as rollout
from palpate.models.planar import Planar as Planar
from palpate.models.planar import PlanarState as PlanarState
from palpate.models.planar_shapes import furniture as furniture
from palpate.models.rope import Rope as Rope
from palpate.models.rope import RopeState as RopeState
