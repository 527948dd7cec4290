"""Two joints of MuJoCo, one on the other, before two cameras and with a hand, for the tests."""

import copy
import functools
import math

import mujoco
import numpy as np

from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.twin import Twin
from palpate.numerics.pinhole import Pinhole
from palpate.perception.clouds import Cloud, cloud_of
from palpate.trials.appliance.score import difference
from palpate.worlds.depth import DepthSensor, depth_image

# A door before a wall, with a flap in it.
SCENE = """
<mujoco>
  <worldbody>
    <geom type="box" size=".02 .9 1.1" pos=".15 0 1.1"/>
    <geom type="box" size=".05 .05 1.1" pos="0 .5 1.1"/>
    <geom type="box" size=".05 .05 1.1" pos="0 -.5 1.1"/>
    <body name="door" pos="0 .44 1.1">
      <joint axis="0 0 1"/>
      <geom type="box" size=".02 .08 1" pos="0 -.08 0"/>
      <geom type="box" size=".02 .08 1" pos="0 -.78 0"/>
      <geom type="box" size=".02 .27 .3" pos="0 -.43 -.7"/>
      <geom type="box" size=".02 .27 .4" pos="0 -.43 .6"/>
      <body name="flap" pos="0 -.43 .19">
        <joint axis="0 1 0"/>
        <geom type="box" size=".02 .26 .28" pos="0 0 -.29"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
DOOR, FLAP = 1, 2


class Room:
    """The door and its flap, seen by two cameras, with a hand that is on one of them."""

    def __init__(self, scene: str = SCENE) -> None:
        self.model = mujoco.MjModel.from_xml_string(scene)
        self.data = mujoco.MjData(self.model)
        self.cameras = [
            Pinhole.looking_at((0.0, 0.0, 1.0), place, 320, 240, math.radians(58.0))
            for place in ((-2.4, 0.9, 1.8), (-2.4, -0.9, 1.5))
        ]
        self.random = np.random.default_rng(0)

    def at(self, door: float, flap: float) -> None:
        """Put both where they are to be, rad."""
        self.data.qpos[:] = door, flap
        mujoco.mj_kinematics(self.model, self.data)

    def look(self) -> Cloud:
        """What the cameras see."""
        taken = [
            depth_image(self.model, self.data, camera, DepthSensor(), self.random)[0]
            for camera in self.cameras
        ]
        return cloud_of(taken)

    def pull(self, twin: Twin, body: int, start: tuple[float, float], end: tuple[float, float]):
        """A hand on a body takes both joints from start to end."""
        self.at(*start)
        before = twin.looks[-1] if twin.looks else self.look()
        point = self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ self.place(body)
        way = []
        for share in np.linspace(0.0, 1.0, 60):
            self.at(*(np.array(start) + share * np.subtract(end, start)))
            turn = self.data.xmat[body].reshape(3, 3)
            way.append(self.data.xpos[body] + turn @ self.place(body))
        points = np.array(way) + 5e-4 * self.random.standard_normal((60, 3))
        direction = points[-1] - points[0]
        push = Push(point, direction / np.linalg.norm(direction))
        after = self.look()
        twin.observe(Handling(push, before, after, np.linspace(0, 2, 60), points, 0.0 * points))
        twin.look(self.look())

    def place(self, body: int) -> np.ndarray:
        """Where a hand holds a body, on it."""
        return np.array([-0.02, -0.78, 0.0]) if body == DOOR else np.array([-0.02, 0.0, -0.5])

    def error(self, twin: Twin, part: int, joint: int) -> tuple[float, float]:
        """Degrees, and cm, from a part's joint to the true one."""
        found = twin.screw(part, len(twin.looks) - 1)
        return difference(found, self.data.xaxis[joint], self.data.xanchor[joint])


Place = tuple[float, float]


def pulled(start: Place, *pulls: tuple[int, Place], kind: type[Room] = Room) -> tuple[Room, Twin]:
    """A room and a twin that has looked at it, and seen one body after another pulled to its place.

    What many tests begin with is computed once; each gets copies that go on as if they were alone.
    """
    room, twin = _pulled(kind, start, pulls)
    return copy.deepcopy(room), twin.copy()


@functools.lru_cache(maxsize=8)
def _pulled(kind: type[Room], start: Place, pulls: tuple) -> tuple[Room, Twin]:
    if not pulls:
        room, twin = kind(), Twin()
        room.at(*start)
        twin.look(room.look())
        return room, twin
    *before, (body, end) = pulls
    room, twin = pulled(start, *before, kind=kind)
    room.pull(twin, body, before[-1][1] if before else start, end)
    return room, twin


class Notes(Twin):
    """A twin that only writes down what a hand has done."""

    def observe(self, handling: Handling) -> None:
        self.handled.append(handling)
