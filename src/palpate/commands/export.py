"""`palpate export`: a policy for robots that know neither JAX nor palpate."""

from pathlib import Path

from palpate.commands import folders
from palpate.commands.options import Export
from palpate.deployment.contract import check_contract, write_actor_contract, write_contract
from palpate.deployment.deployment import Deployment, deployment_of, load_network
from palpate.deployment.onnx_actor import actor_difference, actor_model, guard_model, write_model
from palpate.deployment.onnx_export import difference, write_onnx
from palpate.errors import PalpateError
from palpate.networks import ActorPolicy, CommandPolicy, GuardedPolicy
from palpate.runs import Figure
from palpate.runs.storage import check_writable, write_bytes

AGREES = 5e-6  # of the limit of a command
ACTOR_AGREES = 5e-5  # of its range: trained actors, unlike others, saturate; 1.1e-5 was measured
STEPS = 50  # of 64 episodes each, through which the file is compared
ONNX, REFLEX = "policy.onnx", "policy.reflex.onnx"


def run(options: Export) -> Path:
    """Write the file and its contract, compare it with the policy, and return the file's path.

    A policy that was trained under a reflex has that in a second file, called as the first but for
    its end, ".reflex.onnx".

    Raises `PalpateError` for a file that is no policy, a name that does not end in .onnx, a JSON
    file in the contract's place, without the extra `deploy`, or when a file does not agree.
    """
    target = options.onnx
    beside = target.with_suffix(".json")
    if target.suffix != ".onnx":
        raise PalpateError(f"--onnx {target} has to end in .onnx")
    if beside.exists():
        _check_contract(beside)
    check_writable(target)
    file = folders.product_of(options.policy, folders.POLICY, "train")
    policy, manifest = load_network(file)
    deployment = deployment_of(policy, manifest)
    deployment.stand_behind(options.filter, options.tank)
    with folders.begin(options, "export", {"policy": file}) as run:
        if isinstance(policy, CommandPolicy):
            write_onnx(run.path / ONNX, policy)
            differences = {ONNX: difference(run.path / ONNX, policy, STEPS, options.seed)}
            most = AGREES
        else:
            differences = _actor_written(run.path, policy, deployment, options.seed)
            most = ACTOR_AGREES
        for name, off in differences.items():
            if not off <= most:
                raise PalpateError(
                    f"{run.path / name} gives commands that differ from the policy's by {off:.2g} "
                    f"of their limits: expected at most {most:g}"
                )
        targets = {ONNX: target, REFLEX: target.with_suffix(REFLEX.removeprefix("policy"))}
        for name in differences:
            write_bytes(targets[name], (run.path / name).read_bytes())
        if isinstance(policy, CommandPolicy):
            write_contract(beside, deployment, target.name)
        else:
            reflex = targets[REFLEX].name if REFLEX in differences else None
            write_actor_contract(beside, policy, deployment, target.name, reflex)
        off = max(differences.values())
        if not run.finished:
            figure = Figure("onnx_difference", off, "of the limit", bar=most)
            folders.finish(run, [figure])
        print(f"policy: {target} (commands differ by at most {off:.1g} of their limits)")
        if REFLEX in differences:
            print(f"its reflex: {targets[REFLEX]}")
        print(f"contract: {beside}")
        folders.hand_over(options, run, "A policy as ONNX")
    return target


def _actor_written(
    folder: Path, policy: ActorPolicy, deployment: Deployment, seed: int
) -> dict[str, float]:
    """The graphs in the folder by name, and by how much each differs from the policy."""
    scaling = deployment.scaling
    models = {ONNX: actor_model(policy, scaling)}
    if deployment.pace is not None and isinstance(policy, GuardedPolicy):
        models[REFLEX] = guard_model(policy, scaling)
    for name, model in models.items():
        write_model(folder / name, model)
    return {name: actor_difference(folder / name, policy, scaling, seed) for name in models}


def _check_contract(path: Path) -> None:
    try:
        check_contract(path)
    except PalpateError as error:
        raise PalpateError(
            f"{path}, where the contract would go, holds something else: give another --onnx"
        ) from error
