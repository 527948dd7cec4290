"""What was observed: recordings, their files, and their alignment in time."""

from palpate.recordings.alignment import Aligned as Aligned
from palpate.recordings.channel import Channel as Channel
from palpate.recordings.channel import Events as Events
from palpate.recordings.channel import Role as Role
from palpate.recordings.facts import Driven as Driven
from palpate.recordings.facts import Intrinsics as Intrinsics
from palpate.recordings.facts import Labels as Labels
from palpate.recordings.facts import Polygons as Polygons
from palpate.recordings.facts import Quantity as Quantity
from palpate.recordings.recording import Recording as Recording
from palpate.recordings.recording import join as join
from palpate.recordings.trial import Trial as Trial
