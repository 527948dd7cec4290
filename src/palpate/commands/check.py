"""`palpate check`: what is wrong with a file of links and joints, and a mended copy of it."""

from collections import Counter
from pathlib import Path

from palpate.commands.options import Check
from palpate.errors import DoubtfulResultError, PalpateError
from palpate.families.appliance.mjcf import read_mjcf_links
from palpate.models.articulated.description import MOVING, Description
from palpate.models.articulated.faults import Fault, mend
from palpate.models.articulated.meshes import with_copied_meshes
from palpate.models.articulated.mjcf import write_mjcf
from palpate.models.articulated.urdf import read_urdf, read_xml, write_urdf
from palpate.worlds.descriptions import refusal

FAILING = ("urdfdom", "palpate")  # of what is no number
WRITERS = {".urdf": write_urdf, ".xml": write_mjcf}


def run(options: Check) -> Path | None:
    """Print each fault and what MuJoCo says, write the copy, and return where it is.

    Raises `PalpateError` for a file that is neither URDF nor MJCF, one with a fault that cannot be
    mended by itself, and a copy that would overwrite something; `DoubtfulResultError` where there
    are faults and no copy was asked for, or where MuJoCo does not take the copy either.
    """
    out = options.fix
    if out is not None and out.suffix not in WRITERS:
        expected = f"expected one that ends in {' or '.join(WRITERS)}"
        raise PalpateError(f"--fix {out} is no name for a copy: {expected}")
    if out is not None and out.exists() and not options.fresh:
        raise PalpateError(f"{out} is there already: give another --fix, or --fresh to replace it")
    if read_xml(options.file).tag == "mujoco":
        return check_mjcf(options)
    faults: list[Fault] = []

    def note(where: str, what: str) -> None:
        faults.append(Fault(where, what, FAILING, "taken as missing"))

    description = read_urdf(options.file, note)
    whole, found = mend(description)
    faults += found
    print(f"{options.file}: {contents(description)}")
    for fault in faults:
        print(f"  {fault}")
    lost = [fault for fault in faults if not fault.mend]
    if lost:
        raise PalpateError(f"{options.file} cannot be used: {lost[0].where}: {lost[0].what}")
    print(f"  MuJoCo: {verdict(options.file)}")
    if out is None:
        if faults:
            count = f"{len(faults)} fault{'s' * (len(faults) > 1)}"
            raise DoubtfulResultError(
                f"{options.file} has {count}; `palpate check {options.file} --fix OUT.urdf` writes "
                "a copy without"
            )
        return None
    out.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[out.suffix](out, with_copied_meshes(whole, out.parent, f"{out.stem}_meshes"))
    if reason := refusal(out):
        raise DoubtfulResultError(f"{out} is written, and MuJoCo does not take it: {reason}")
    print(f"mended: {out}, which MuJoCo takes, and every joint moves there")
    return out


def check_mjcf(options: Check) -> None:
    """Whether MuJoCo takes an MJCF file, what moves in it, and what a tree of links would lack."""
    if options.fix is not None:
        raise PalpateError(f"{options.file} is MJCF, which MuJoCo alone reads: --fix is for URDF")
    links, names = read_mjcf_links(options.file)
    kinds = Counter(link.joint for link in links)
    shown = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    count = len(set(names))
    print(f"{options.file}: {count} joint{'s' * (count > 1)}: {shown}")
    if reason := refusal(options.file):
        raise DoubtfulResultError(f"{options.file}: {reason}")
    print(f"  MuJoCo: {verdict(options.file)}")


def contents(description: Description) -> str:
    """How many links and joints there are, in words."""
    kinds = Counter(joint.kind for joint in description.joints)
    moving = [f"{kinds[kind]} {kind}" for kind in MOVING if kinds[kind]]
    links = len(description.links)
    return f"{links} link{'s' * (links != 1)}; joints: {', '.join(moving) or 'none that moves'}"


def verdict(path: Path) -> str:
    """What MuJoCo does with a file."""
    reason = refusal(path)
    return f"does not take it: {reason}" if reason else "takes it, and every joint moves"
