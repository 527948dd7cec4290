"""Appliances out of URDF and MJCF files of others, to be handled as those of the generator are."""

import tempfile
import warnings
from pathlib import Path

import mujoco

from palpate.errors import PalpateError, PalpateWarning
from palpate.models.articulated.faults import mend
from palpate.models.articulated.meshes import with_copied_meshes
from palpate.models.articulated.mjcf import write_mjcf
from palpate.models.articulated.urdf import read_urdf, read_xml
from palpate.worlds.appliance.foreign import foreign_scene
from palpate.worlds.appliance.scene import Scene


def read_scene(file: str | Path, body: str | None = None) -> Scene:
    """The scene of a URDF or MJCF file; `body` names the only one that is kept of it.

    Faults of a URDF are mended, where they can be (`palpate.models.articulated.faults`), with a
    warning. Raises `PalpateError` for a file that is neither or cannot be mended, and as
    `foreign_scene`.
    """
    file = Path(file)
    kind = read_xml(file).tag
    if kind == "mujocoinclude":
        raise PalpateError(f"{file} is a piece that other files include: give one that does")
    if kind not in ("mujoco", "robot"):
        raise PalpateError(f"{file} holds <{kind}>: expected <robot> of URDF or <mujoco> of MJCF")
    if kind == "mujoco":
        return foreign_scene(_parse(file), file, body)
    doubts: list[str] = []
    description, faults = mend(read_urdf(file, lambda where, what: doubts.append(where)))
    for fault in faults:
        if not fault.mend:
            raise PalpateError(f"{file}: {fault}")
    if count := len(faults) + len(doubts):
        said = f"{count} fault{'s' * (count > 1)} of {file} mended: `palpate check` names them"
        warnings.warn(said, PalpateWarning, stacklevel=2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mended.xml"
        write_mjcf(path, with_copied_meshes(description, path.parent, "meshes"))
        return foreign_scene(_parse(path), file, body)


def _parse(file: Path) -> mujoco.MjSpec:
    try:
        return mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise PalpateError(f"MuJoCo cannot use {file}: {reason}") from error
