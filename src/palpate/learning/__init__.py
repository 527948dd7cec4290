"""From a model or a world to a policy."""

from palpate.learning.closed_loop import simulate as simulate
from palpate.learning.self_supervised import Training as Training
from palpate.learning.self_supervised import train as train
