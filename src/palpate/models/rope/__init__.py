"""A rope as a chain of point masses, springs and dampers."""

from palpate.models.rope.parameters import RopeState as RopeState
from palpate.models.rope.rope import Rope as Rope
