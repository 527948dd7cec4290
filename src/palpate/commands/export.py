"""`palpate export`: a policy for robots that know neither JAX nor palpate."""

from pathlib import Path

from palpate.commands import folders
from palpate.commands.options import Export
from palpate.deployment.contract import check_contract, write_contract
from palpate.deployment.onnx_export import difference, write_onnx
from palpate.errors import PalpateError
from palpate.networks import load_policy
from palpate.runs import Figure
from palpate.runs.storage import check_writable, write_bytes

AGREES = 5e-6  # of the limit of a command
STEPS = 50  # of 64 episodes each, through which the file is compared
ONNX = "policy.onnx"


def run(options: Export) -> Path:
    """Write the file and its contract, compare it with the policy, and return the file's path.

    Raises `PalpateError` for a file that is no policy, a name that does not end in .onnx, a JSON
    file in the contract's place, without the extra `deploy`, or when the file does not agree.
    """
    target = options.onnx
    beside = target.with_suffix(".json")
    if target.suffix != ".onnx":
        raise PalpateError(f"--onnx {target} has to end in .onnx")
    if beside.exists():
        _check_contract(beside)
    check_writable(target)
    file = folders.product_of(options.policy, folders.POLICY, "train")
    policy, manifest = load_policy(file)
    with folders.begin(options, "export", {"policy": file}) as run:
        made = run.path / ONNX
        write_onnx(made, policy)
        off = difference(made, policy, STEPS, options.seed)
        if not off <= AGREES:
            raise PalpateError(
                f"{made} gives commands that differ from the policy's by {off:.2g} of their "
                f"limits: expected at most {AGREES:g}"
            )
        write_bytes(target, made.read_bytes())
        write_contract(beside, policy, manifest, target.name)
        if not run.finished:
            figure = Figure("onnx_difference", off, "of the limit", bar=AGREES)
            folders.finish(run, [figure])
        print(f"policy: {target} (commands differ by at most {off:.1g} of their limits)")
        print(f"contract: {beside}")
        folders.hand_over(options, run, "A policy as ONNX")
    return target


def _check_contract(path: Path) -> None:
    try:
        check_contract(path)
    except PalpateError as error:
        raise PalpateError(
            f"{path}, where the contract would go, holds something else: give another --onnx"
        ) from error
