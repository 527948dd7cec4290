"""`palpate reproduce twin-foreign`: appliances of other people's sets, as they are.

The kitchen of Gymnasium-Robotics and the objects of Meta-World, out of the files of the installed
packages, of which nothing is run. Every file is tried: it is loaded or refused with its fault. What
moves is then handled as `palpate reproduce twin-interactive` handles its own, from several starts.

Hinged and sliding parts longer than `LONG` count. Others are found beside them and printed: smaller
ones, knobs and dials, which turn about their own middle, and what a file ties to another joint.
"""

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.experiments.appliance.twin_interactive import EACH, MORE, plain
from palpate.experiments.experiment import Experiment, share_of
from palpate.families.appliance.foreign import read_scene
from palpate.identification.interactive.twin import Twin
from palpate.learning.active import CHOICES
from palpate.runs import Figure, Result
from palpate.trials.appliance.interaction import interact
from palpate.trials.appliance.score import Labels, real_labels, score
from palpate.worlds.appliance.appliance import ApplianceWorld
from palpate.worlds.appliance.foreign import seen_corners
from palpate.worlds.appliance.scene import Scene, labels_of

NAME = "twin-foreign"
SETS = {
    "gymnasium_robotics": "envs/assets/kitchen_franka",
    "metaworld": "assets/objects",
}
INSTALL = "pip install --no-deps gymnasium-robotics==1.4.2 metaworld==3.1.1"
KITCHEN = "kitchen_assets/kitchen_env_model.xml"
BODIES = ("microwave", "hingecabinet", "slidecabinet", "oven")  # of the kitchen
ROBOT = "xyz_base"  # among Meta-World's objects
FIRST, STARTS = 710_000, 3
QUICK = "drawer"
LONG = 0.10  # m
KNOB = 0.1  # of its length that the axis of a knob passes its middle by at most
PLACES = ("degrees", "centimetres")
MINUTES = {"objects": 4}


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Load every file and handle what moves below `out`; `quick` is one object.

    Raises `PalpateError` when `out` holds other runs and where a set is not installed.
    """
    experiment = Experiment(NAME, out, quick, seed)
    experiment.announce({"objects": 1} if quick else MINUTES)
    folders = {name: folder_of(name) for name in SETS}
    kitchen, table = folders["gymnasium_robotics"], folders["metaworld"]
    loaded = experiment.found("files", {"sets": list(SETS)}, lambda: files([*folders.values()]))
    things = [(str(kitchen / KITCHEN), body) for body in BODIES]
    things += [
        (name, "") for name in loaded["loaded"]
        if Path(name).parent == table and Path(name).stem != ROBOT
    ]  # fmt: skip
    if quick:
        things = [one for one in things if Path(one[0]).stem == QUICK]
    first = experiment.uses(FIRST, 1 if quick else STARTS)
    starts = range(first, first + (1 if quick else STARTS))
    grid = [(*thing, start) for thing in things for start in starts]
    experiment.on_every_core(of_object, grid, "objects")
    found = [of_object(experiment, *one) for one in grid]
    return experiment.result(
        figures(loaded, found),
        {"starts": len(starts), "pushes": f"{EACH} for each part and {MORE}", "sets": SETS},
        "nothing is fitted to any of them",
    )


def folder_of(package: str) -> Path:
    """Where the files of an installed package are, none of which is run; raises `PalpateError`."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise PalpateError(
            f"{NAME} reads the files of {package}, which is not installed: `{INSTALL}` brings it "
            "(without what it depends on, of which nothing is needed)"
        )
    return Path(spec.submodule_search_locations[0]) / SETS[package]


def files(folders: Sequence[Path]) -> dict[str, Any]:
    """Which MJCF and URDF files load, which are refused and why, and on which palpate fails."""
    found: dict[str, Any] = {"loaded": [], "refused": {}, "failed": {}}
    for path in sorted(path for folder in folders for path in folder.rglob("*.xml")):
        try:
            read_scene(path)
            found["loaded"].append(str(path))
        except PalpateError as error:
            found["refused"][str(path)] = str(error)
        except Exception as error:  # what this looks for
            found["failed"][str(path)] = f"{type(error).__name__}: {error}"
    return found


def of_object(experiment: Experiment, file: str, body: str, start: int) -> dict[str, Any]:
    """What was found of an object from one start, part by part, in a stage of its own."""
    name = body or Path(file).stem

    def work() -> dict[str, Any]:
        world = ApplianceWorld(read_scene(file, body or None))
        world.reset(start)
        pushes = EACH * len(world.parts) + MORE
        twin, real = Twin(), dict[int, Labels]()
        for state in interact(world, CHOICES["information"], pushes, start):
            twin = state.twin
            real[len(twin.looks) - 1] = real_labels(twin, world)
        last = score(twin, world, real)
        parts = [
            {
                "part": part.name,
                "counts": counts(world.scene, number),
                **{key: plain(float(getattr(last, key)[number]))
                   for key in ("found", "type_right", *PLACES, "iou")},
            }
            for number, part in enumerate(world.parts)
        ]  # fmt: skip
        return {"object": name, "parts": parts, "extra": last.extra}

    return experiment.found(f"{name}-{start}", {"object": name, "start": start}, work)


def counts(scene: Scene, number: int) -> bool:
    """Whether a part is long, no knob, and tied to no part before it."""
    part, model, joint = scene.parts[number], scene.model, scene.joints[number]
    ties = [
        {int(model.eq_obj1id[row]), int(model.eq_obj2id[row])}
        for row in range(model.neq)
        if model.eq_type[row] == mujoco.mjtEq.mjEQ_JOINT
    ]
    if part.size <= LONG or any(joint in tie and min(tie) < joint for tie in ties):
        return False
    if part.joint == "prismatic":
        return True
    data = mujoco.MjData(model)
    data.qpos[scene.addresses] = scene.closed
    mujoco.mj_forward(model, data)
    corners = seen_corners(model, data, labels_of(model, scene.bodies) == number)
    away = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) - data.xanchor[joint]
    return bool(np.linalg.norm(np.cross(data.xaxis[joint], away)) > KNOB * part.size)


def figures(loaded: Mapping[str, Any], found: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """What counts, over all starts; then each object's parts."""
    of = {name: len(loaded[name]) for name in ("loaded", "refused", "failed")}
    explained = of["loaded"] + of["refused"]
    every = [one for each in found for one in each["parts"]]
    counted = [one for one in every if one["counts"]]
    right = [one for one in counted if one["type_right"]]
    listed = [
        *(Figure(f"axis_{unit}", mean(right, name), unit, 2.0)
          for name, unit in zip(PLACES, ("deg", "cm"), strict=True)),
        share_of("recall", sum(one["found"] == 1.0 for one in counted), len(counted), bar=0.8),
        share_of("loaded_or_explained", explained, sum(of.values()), bar=1.0),
        share_of("type_accuracy", len(right), sum(one["found"] == 1.0 for one in counted)),
        Figure("miou", mean(counted, "iou"), "", better="higher"),
        Figure("extra", float(sum(each["extra"] for each in found)), ""),
        Figure("parts", float(len(counted)), "", better="higher"),
        Figure("loaded", float(of["loaded"]), "", better="higher"),
        Figure("refused", float(of["refused"]), ""),
    ]  # fmt: skip
    small = [one for one in every if not one["counts"]]
    listed.append(share_of("small.recall", sum(one["found"] == 1.0 for one in small), len(small)))
    names = dict.fromkeys((each["object"], one["part"]) for each in found for one in each["parts"])
    for thing, part in names:
        own = [one for each in found if each["object"] == thing
               for one in each["parts"] if one["part"] == part]  # fmt: skip
        key = f"detail.{thing}.{part}"
        listed += [
            share_of(f"{key}.recall", sum(one["found"] == 1.0 for one in own), len(own)),
            Figure(f"{key}.axis_deg", mean(own, "degrees"), "deg"),
        ]
    return listed


def mean(parts: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """Over what is known; None of nothing."""
    values = [one[name] for one in parts if one[name] is not None]
    return float(np.mean(values)) if values else None
