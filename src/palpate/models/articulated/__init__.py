"""Trees of rigid links with hinges and slides: appliances, arms, free bodies."""

from palpate.models.articulated.articulated import Articulated as Articulated
from palpate.models.articulated.fingertip import Fingertip as Fingertip
from palpate.models.articulated.fingertip import with_fingertip as with_fingertip
from palpate.models.articulated.links import FREE as FREE
from palpate.models.articulated.links import Link as Link
from palpate.models.articulated.links import free_links as free_links
from palpate.models.articulated.links import tree_of as tree_of
from palpate.models.articulated.parameters import ArticulatedState as ArticulatedState
