"""What was observed: recordings, their files, and their alignment in time."""

from palpate.recordings.recording import Aligned as Aligned
from palpate.recordings.recording import Channel as Channel
from palpate.recordings.recording import Recording as Recording
from palpate.recordings.recording import Role as Role
from palpate.recordings.recording import Trial as Trial
from palpate.recordings.recording import join as join
