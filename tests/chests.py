"""A chest whose lid folds: both leaves are one surface, and most pulls move both joints."""

import numpy as np

from palpate.identification.interactive.twin import Twin
from rooms import Room

LID = """
<mujoco>
  <worldbody>
    <geom type="box" size=".35 .6 .02" pos="0 0 .4"/>
    <geom type="box" size=".02 .6 .2" pos=".35 0 .6"/>
    <body name="lid" pos=".33 0 .8">
      <joint axis="0 1 0"/>
      <geom type="box" size=".16 .55 .01" pos="-.17 0 0"/>
      <body name="leaf" pos="-.34 0 0">
        <joint axis="0 1 0"/>
        <geom type="box" size=".16 .55 .01" pos="-.165 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
# The same with walls that its lid hides, on a floor.
DEEP = """
<mujoco>
  <worldbody>
    <geom type="box" size="3 3 .01"/>
    <geom type="box" size=".35 .6 .02" pos="0 0 .1"/>
    <geom type="box" size=".02 .6 .34" pos=".35 0 .45"/>
    <geom type="box" size=".02 .6 .34" pos="-.37 0 .45"/>
""" + LID[LID.index("    <body") :]
CHEST_LID, LEAF = 1, 2


class Chest(Room):
    """A chest with a folding lid, and a hand at the far edge of that or of its leaf."""

    def place(self, body: int) -> np.ndarray:
        return np.array([-0.3, 0.1, 0.01])


def opened(chest: Chest) -> Twin:
    """A twin that has seen the lid open and close, with its leaf straight on."""
    twin = Twin()
    chest.at(0.0, 0.0)
    twin.look(chest.look())
    chest.pull(twin, LEAF, (0.0, 0.0), (0.7, 0.0))
    chest.pull(twin, LEAF, (0.7, 0.0), (0.05, 0.0))
    assert [len(part.ways) for part in twin.parts] == [2]
    return twin
