"""What is wanted of a rope."""

from palpate.tasks.rope.stabilization import RopeStabilization as RopeStabilization
from palpate.tasks.rope.tracking import RopeTracking as RopeTracking
