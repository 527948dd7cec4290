"""`palpate interact`: handle an appliance until its joints are known, and write its twin."""

import functools
from pathlib import Path

from palpate.commands import folders
from palpate.commands.options import Interact
from palpate.errors import PalpateError
from palpate.families.appliance.foreign import read_scene
from palpate.families.appliance.twin_picture import FILM, PICTURE, film_twin, show_twin
from palpate.identification.interactive.description import describe
from palpate.identification.interactive.forces.dynamics import Dynamics, dynamics_of
from palpate.identification.interactive.twin import Twin
from palpate.learning.active import CHOICES, WORTHS, choose_best
from palpate.learning.movable_guess import load_guess
from palpate.models.articulated.mjcf import write_mjcf
from palpate.models.articulated.urdf import write_urdf
from palpate.runs.run import RESULT
from palpate.runs.storage import read_json
from palpate.trials.appliance.interaction import interact
from palpate.trials.appliance.score import Labels, figures_of, real_labels, score
from palpate.worlds.appliance.appliance import ApplianceWorld

UNITS = {"revolute": ("kg m^2", "N m", "N m s"), "prismatic": ("kg", "N", "N s/m")}
TWIN, OTHER = "twin.urdf", "twin.xml"


def run(options: Interact) -> Path:
    """Handle the appliance, say what was found, and return where the twin is.

    Raises `PalpateError` for a category that there is not, for a file as `read_scene`, and where
    nothing was found to move.
    """
    given = {"file": options.file, "guess": options.guess}
    inputs = {name: path for name, path in given.items() if path is not None}
    with folders.begin(options, "interact", inputs) as run:
        if not run.finished:
            source = read_scene(options.file, options.body) if options.file else options.world
            world = ApplianceWorld(source, options.seed, views=options.views)
            world.reset(options.seed)
            choose, twin = CHOICES[options.choose], Twin()
            if options.guess is not None:
                guess = load_guess(options.guess)
                choose = functools.partial(choose_best, worth=WORTHS[options.choose], guess=guess)
            real: dict[int, Labels] = {}
            for number, step in enumerate(interact(world, choose, options.pushes, options.seed)):
                twin = step.twin
                real[len(twin.looks) - 1] = real_labels(twin, world)
                if number:
                    print(f"push {number}: {said(twin)}", flush=True)
            description = describe(twin, options.name)
            lines = rows(twin)
            try:
                felt = dynamics_of(twin)
            except PalpateError as error:
                lines.append(f"masses and resistance are guesses: {error}")
            else:
                description = felt.describe_with(description)
                lines += [*resistances(twin, felt), *(f"warning: {one}" for one in felt.warnings)]
            write_urdf(run.path / TWIN, description)
            write_mjcf(run.path / OTHER, description)
            twin.relabel(0)  # of parts that were found later, too
            show_twin(run.path / PICTURE, twin, options.name)
            film_twin(run.path / FILM, twin, description)
            figures = figures_of([score(twin, world, real)])
            known = [one for one in figures if one.value is not None]  # no hinge has no place
            folders.finish(run, known, {folders.SUMMARY: lines})
        print("\n".join(read_json(run.path / RESULT)["settings"][folders.SUMMARY]))
        folders.hand_over(options, run, f"Twin: {options.name}")
        print(f"twin: {run.path / TWIN}")
        print(f"picture: {run.path / PICTURE}")
        return run.path / TWIN


def said(twin: Twin) -> str:
    """What came of the last push, in a few words."""
    handling = twin.handled[-1]
    parts = f"{len(twin.parts)} part{'s' * (len(twin.parts) != 1)}"
    if not handling.held:
        return f"no hold; {parts}"
    if not handling.moved:
        return f"nothing moved; {parts}"
    return f"moved {100.0 * handling.travel:.0f} cm; {parts}"


def rows(twin: Twin) -> list[str]:
    """Each part's joint with its intervals, a line each."""
    found = []
    for number, part in enumerate(twin.parts):
        angle, place = part.estimate.intervals
        x, y, z = part.screw.axis
        on = "" if part.parent < 0 else f" on part {part.parent + 1}"
        at = f", its place to {100.0 * place:.1f} cm" if part.screw.joint == "revolute" else ""
        found.append(
            f"part {number + 1}: {part.screw.joint}{on}, axis ({x:.3f}, {y:.3f}, {z:.3f}) to "
            f"{angle:.1f} degrees{at} (90 %)"
        )
    return found


def resistances(twin: Twin, known: Dynamics) -> list[str]:
    """What resists at each joint with 90 % intervals, a line each; of parts that were moved."""
    found = []
    for part, own, inertia in zip(known.parts, known.resistance, known.inertia, strict=True):
        if own is None:
            continue
        kind = twin.parts[part].screw.joint
        of_mass, of_force, of_damping = UNITS[kind]
        share, damping, friction, *_ = 1.645 * own.deviation
        what = "inertia" if kind == "revolute" else "mass"
        found.append(
            f"part {part + 1}: {what} {inertia:.3g} {of_mass} to "
            f"{100.0 * share / own.mass_share:.0f} %, friction {own.friction:.3g} +- "
            f"{friction:.3g} {of_force}, damping {own.damping:.3g} +- {damping:.3g} "
            f"{of_damping} (90 %)"
        )
    return found
