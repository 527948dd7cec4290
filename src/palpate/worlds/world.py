"""The contract of a world: what can be done to it, and what it lets out."""

from __future__ import annotations

import atexit
import functools
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from palpate.errors import PalpateError

if TYPE_CHECKING:
    import mujoco

GL_PACKAGES = ("libegl1", "libopengl0", "libgl1-mesa-dri")


class DivergedError(PalpateError):
    """A simulation became too fast for its time step: this episode is lost, and no other."""


class Meter(NamedTuple):
    """Energy in J, as the simulator knows it: for those who audit a controller, and for tests."""

    stored: float  # kinetic and potential, of all that moves; less what contacts store
    work: float  # done from outside since the reset, by whatever is not the controller


class World(ABC):
    """A piece of reality that is acted upon and observed once per control period.

    A world hides its parameters. An observation holds only what a sensor could see, with its
    noise and delay, and carries `time`: the seconds since `reset` at which it was measured.
    The same seed and the same actions give the same observations.

    `reset` and `step` raise `DivergedError` when the simulation diverges; the next `reset` starts
    afresh.
    """

    @property
    @abstractmethod
    def control_period(self) -> float:
        """Seconds that one call of `step` advances the world."""

    @abstractmethod
    def reset(self, seed: int, **options: Any) -> Any:
        """Start a new episode and return its first observation; `seed` draws all randomness."""

    @abstractmethod
    def step(self, action: Any) -> Any:
        """Hold `action` for one control period and return the newest observation."""

    @abstractmethod
    def truth(self) -> Any:
        """The hidden state and parameters, for experiments and tests alone."""

    @abstractmethod
    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        """A picture of the present state, uint8 of shape (height, width, 3).

        Raises `PalpateError`, naming the packages to install, where the machine has no OpenGL.
        """

    def meter(self) -> Meter:
        """What is stored, and what came from outside since the reset: judges and tests alone.

        Raises `PalpateError` where nobody has told a world to count it.
        """
        raise PalpateError(f"{type(self).__name__} has no meter of energy")

    def rollout(self, worlds: Sequence[World]) -> Rollout | None:
        """What advances this world and all beside it by whole decisions at once, where that is
        faster than one control period after another; None: nothing does."""
        return None


@runtime_checkable
class ControlLaw(Protocol):
    """What turns the decision in force into what is done in each control period.

    It serves worlds side by side: observations and all it takes and gives lead with an axis of
    worlds (`side_by_side`). A filter or a reflex is a control law that wraps another.
    """

    def begin(self, observation: Any, action: np.ndarray, fresh: np.ndarray) -> None:
        """A decision: from now on `action` (worlds, ...) holds; `fresh` (worlds,) bool where an
        episode has just begun, of which nothing may be carried over."""

    def command(self, observation: Any) -> np.ndarray:
        """What to do in the next control period (worlds, ...): asked in each, the first as well."""
        ...


def innermost(law: Any) -> Any:
    """What a law wraps in the end: the law that no reflex and no filter is."""
    while (inner := getattr(law, "law", None)) is not None:
        law = inner
    return law


@runtime_checkable
class InterruptingLaw(ControlLaw, Protocol):
    """A control law that may put another action in the place of the one under way.

    After each `command`, `executed` (worlds, ...) is what is under way and `interrupted` (worlds,)
    bool whether it was replaced in this very period: again only after `pace` control periods, or
    once in a decision where a sensor failed.
    """

    pace: int
    executed: np.ndarray
    interrupted: np.ndarray


@runtime_checkable
class Drive(Protocol):
    """What stands between the servos of a world's robot and the robot, such as a filter."""

    def begin(self) -> None:
        """An episode begins."""

    def __call__(self, force: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """The force (axes,) N that is given in the next time step in place of the servos', where
        encoders show a position (m) and a velocity (m/s), all (axes,)."""
        ...


class Spring(NamedTuple):
    """What pulls the tips of worlds side by side to set-points: F = K (x_d - x) - D xdot."""

    target: np.ndarray  # (worlds, 2) m, in the frame of the observed position
    stiffness: np.ndarray  # (worlds, 2, 2) N/m, symmetric
    damping: np.ndarray  # (worlds, 2, 2) N s/m, symmetric


@runtime_checkable
class SpringLaw(ControlLaw, Protocol):
    """A control law that can be no more than a spring and a damper from decision to decision."""

    def spring(self) -> Spring | None:
        """What pulls until the next decision; None where it is not that alone."""
        ...


@runtime_checkable
class MeteredLaw(ControlLaw, Protocol):
    """A control law that knows what energy its commands draw, and what is left in a tank.

    `level` (worlds,) J is that of the tank, None without one; `drawn` (worlds,) J what commands of
    this decision have put into the robot, without what they took out; `flow` (worlds,) W the most
    that they gave in a control period.
    """

    drawn: np.ndarray
    flow: np.ndarray

    @property
    def level(self) -> np.ndarray | None:
        """See the class."""
        ...

    def book(self, drawn: np.ndarray) -> None:
        """Of a decision that was one spring (worlds, periods) J, period by period."""
        ...


class Held(NamedTuple):
    """What came of a spring that was held in worlds side by side."""

    observations: list[Any]  # the last of each world
    truths: list[Any]
    force: np.ndarray  # (worlds,) N, the greatest contact force
    violated: np.ndarray  # (worlds,) bool: it was above the limit, and the world has stopped there
    diverged: np.ndarray  # (worlds,) bool: the simulation did, and the world is to begin anew
    drawn: np.ndarray  # (worlds, periods) J that the spring's force did; 0 when it had stopped


class Rollout(Protocol):
    """Worlds side by side that are advanced together, by many control periods in one call."""

    def hold(self, spring: Spring, periods: int, force_limit: float) -> Held:
        """As `periods` steps under the spring's force, until a contact force is above the limit."""
        ...


def side_by_side(observations: Sequence[Any]) -> Any:
    """Observations of several worlds as one of their kind, whose fields lead with the worlds.

    Raises `PalpateError` for observations that are no named tuples.
    """
    kind = type(observations[0])
    if not hasattr(kind, "_make"):
        raise PalpateError(
            f"worlds side by side give named tuples of numbers and arrays, not {kind.__name__}"
        )
    return kind._make(map(np.array, zip(*observations, strict=True)))


class Decimated(World):
    """A world seen by a slower decision: each action is held for `every` control periods.

    `law`, if given, stands between the two rates: of the newest observation and the action it
    makes what is done in the next control period. The observation returned is the last one.
    """

    def __init__(self, world: World, every: int, law: ControlLaw | None = None):
        self.world, self.every, self.law = world, whole_periods(every), law
        self._observation: Any = None
        self._fresh = True

    @property
    def control_period(self) -> float:
        return self.every * self.world.control_period

    def reset(self, seed: int, **options: Any) -> Any:
        self._observation, self._fresh = self.world.reset(seed, **options), True
        return self._observation

    def step(self, action: Any) -> Any:
        if self.law:
            seen = side_by_side([self._observation])
            self.law.begin(seen, np.asarray(action)[None], np.array([self._fresh]))
            self._fresh = False
        for _ in range(self.every):
            if self.law is None:
                done = action
            else:
                done = self.law.command(side_by_side([self._observation]))[0]
            self._observation = self.world.step(done)
        return self._observation

    def truth(self) -> Any:
        return self.world.truth()

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        return self.world.render(width, height)


def whole_periods(every: int) -> int:
    """For how many control periods a decision is held; raises `PalpateError` for fewer than one."""
    if not isinstance(every, int | np.integer) or every < 1:
        raise PalpateError(
            f"a decision is held for a whole number of control periods, 1 or more, not {every}"
        )
    return int(every)


@functools.cache
def _gl_context() -> Any:
    """The one OpenGL context of this process; pictures of any size are drawn beside its window."""
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        from mujoco.egl import GLContext
    else:
        from mujoco import GLContext
    context = GLContext(64, 64)
    atexit.register(context.free)  # while the libraries it calls are still there
    return context


class OffscreenCamera:
    """Draws a MuJoCo model without a window.

    OpenGL is first touched when the camera is made, so that a machine without it can run every
    world. The back end is EGL on Linux, unless the variable MUJOCO_GL names another. `width` and
    `height` are the picture's, in pixels.

    Raises `PalpateError` for a size that is not positive, and where OpenGL does not start.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        import mujoco

        if min(width, height) < 1:
            raise PalpateError(f"a picture is at least 1 x 1 pixel, not {width} x {height}")
        self.model, self.width, self.height = model, width, height
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        try:
            self._gl = _gl_context()
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # a missing library shows as almost any type of exception
            raise PalpateError(
                "rendering needs OpenGL, which did not start here "
                f"({type(error).__name__}: {error}); on Debian and Ubuntu install "
                f"{', '.join(GL_PACKAGES[:-1])} and {GL_PACKAGES[-1]}"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)

    def picture(self, data: mujoco.MjData, view: mujoco.MjvCamera) -> np.ndarray:
        """The state `data` seen from `view`: uint8 of shape (height, width, 3)."""
        import mujoco

        self._gl.make_current()
        mujoco.mjv_updateScene(
            self.model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )  # fmt: skip
        frame = mujoco.MjrRect(0, 0, self.width, self.height)
        mujoco.mjr_render(frame, self._scene, self._context)
        pixels = np.empty((self.height, self.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, frame, self._context)
        return pixels[::-1].copy()  # OpenGL counts rows from below
