"""A compliant tip that touches walls."""

from palpate.models.contact.tip import Tip as Tip
from palpate.models.contact.tip import TipState as TipState
from palpate.models.contact.tip import tip_with_walls as tip_with_walls
