"""The pages of the reference, made of docstrings: which modules they show, and who is called when.

A stage of the loop is a page. A module is shown with all that is public and defined in it.
"""

from pathlib import Path

from palpate.cli import COMMANDS, Command

# Paths below palpate, in the order in which somebody needs them; the first gives the page its name.
STAGES = {
    "commands": [
        *(f"commands.{name}" for name in COMMANDS),
        *("commands.options", "families.options", "families.rope.options"),
        *("families.rope.control_options", "families.rope.demo"),
        *("families.furniture.options", "families.own.options"),
        *("families.world_options", "families.contact.maze_options"),
        *("families.contact.navigation_options", "families.contact.skill_options"),
        *("families.contact.touch_options", "families.gymnasium.options"),
        "families.appliance.options",
    ],
    "recordings": [
        *("recordings.recording", "recordings.trial", "recordings.channel", "recordings.facts"),
        *("recordings.alignment", "recordings.files", "recordings.npz", "recordings.csv"),
        *("recordings.columns", "recordings.markers", "recordings.lerobot", "recordings.rerun"),
        *("recordings.rosbag.bag", "families.rope.recording", "families.furniture.recording"),
        *("families.appliance.recording", "families.appliance.cloud_folder"),
        "families.appliance.cloud_log",
    ],
    "models": [
        *("models.model", "models.contract", "models.files", "models.python_files", "parameters"),
        *("models.residual", "models.rope.rope", "models.rope.parameters"),
        *("models.planar.planar", "models.planar.parameters", "models.planar.shapes"),
        *("models.planar.wheels", "families.furniture.structures"),
        *("models.contact.tip", "families.contact.touches"),
        *("models.articulated.articulated", "models.articulated.parameters"),
        *("models.articulated.links", "models.articulated.description"),
        "models.articulated.fingertip",
        *("models.articulated.urdf", "models.articulated.faults", "models.articulated.meshes"),
        *("models.articulated.assembly", "models.articulated.mjcf", "families.appliance.mjcf"),
    ],
    "identification": [
        *("identification.identify", "identification.declarations", "identification.verdicts"),
        *("identification.data.prediction", "identification.gradient.descent"),
        *("identification.gradient.least_squares", "identification.gradient.residual"),
        *("identification.posterior.posterior", "identification.posterior.predictive"),
        *("identification.posterior.comparison", "identification.posterior.calibration"),
        *("identification.posterior.diagnostics", "identification.posterior.files"),
        "identification.posterior.settled",
        *("identification.interactive.twin", "identification.interactive.tree"),
        "identification.interactive.kinematics",
        *("identification.interactive.explanation", "identification.interactive.discovery"),
        *("identification.interactive.shape", "identification.interactive.registration"),
        *("identification.interactive.handling", "identification.interactive.edges.pieces"),
        *("identification.interactive.edges.splitting", "identification.interactive.edges.folding"),
        "identification.interactive.edges.hinge_pairs",
        *("identification.interactive.averaging", "identification.interactive.duplicates"),
        *("identification.interactive.insertion", "identification.interactive.hindsight"),
        *("identification.interactive.screws", "identification.interactive.ways"),
        *("identification.interactive.two_joints", "identification.interactive.labels"),
        *("identification.interactive.refinement", "identification.interactive.description"),
        "identification.interactive.forces.resistance",
        "identification.interactive.forces.action",
        "identification.interactive.forces.dynamics",
        *("identification.samplers.draws", "identification.samplers.target"),
        *("identification.samplers.hamiltonian", "identification.samplers.metropolis"),
        *("identification.samplers.local_global", "identification.samplers.tempered"),
        *("identification.regression.locally_weighted", "identification.regression.model"),
        "identification.regression.gaussian_process",
    ],
    "learning": [
        *("learning.active", "learning.repeats"),
        *("learning.movable", "learning.movable_guess"),
        *("learning.self_supervised", "learning.closed_loop", "learning.dagger"),
        *("learning.loss_monitor", "networks.policy", "networks.controller", "networks.channels"),
        *("learning.off_policy.loop", "learning.off_policy.agent", "learning.off_policy.buffer"),
        *("learning.off_policy.sac", "learning.off_policy.ddpg", "learning.off_policy.recovery"),
        *("learning.off_policy.constrained", "learning.off_policy.reflex"),
        *("learning.off_policy.safety_critic", "learning.off_policy.rollouts"),
        *("networks.actor", "networks.guarded", "networks.in_numpy"),
        "families.gymnasium.methods",
        *("tasks.task", "tasks.rope.stabilization", "tasks.rope.tracking", "tasks.rope.paths"),
        "tasks.furniture.cart",
    ],
    "planning": [
        *("planning.command_curve", "planning.sampling", "planning.gradient", "planning.open_loop"),
        *("planning.movable_obstacles.maps.files", "planning.movable_obstacles.maps.map"),
        *("planning.movable_obstacles.search.planner", "planning.movable_obstacles.search.plan"),
        "planning.movable_obstacles.search.verification",
        "planning.movable_obstacles.motion.belief",
    ],
    "worlds": [
        *("worlds.world", "worlds.camera", "worlds.excitation", "worlds.rope.configuration"),
        *("worlds.rope.rope", "worlds.rope.mjcf", "worlds.rope.filmed"),
        "families.rope.counterpart",
        *("worlds.furniture.pieces", "worlds.furniture.furniture", "worlds.furniture.robot"),
        *("worlds.furniture.handling", "worlds.gymnasium", "worlds.motions"),
        *("families.contact.environments", "families.gymnasium.environments", "worlds.velocity"),
        *("worlds.maze.tip", "worlds.maze.maze", "worlds.maze.mjcf", "worlds.maze.layout"),
        *("worlds.maze.navigation", "worlds.mjcf"),
        *("worlds.arm.maze", "worlds.arm.panda", "worlds.arm.control", "worlds.arm.joints"),
        *("worlds.contact.plates", "worlds.contact.touching"),
        *("worlds.appliance.appliance", "worlds.appliance.categories", "worlds.appliance.design"),
        *("worlds.appliance.fittings", "worlds.appliance.foreign", "worlds.depth"),
        *("worlds.appliance.generated", "worlds.appliance.scene", "families.appliance.foreign"),
        *(
            "safety.impedance",
            "safety.self_tuning",
            "safety.joint_impedance",
            "safety.reflex",
            "safety.port",
            "safety.energy_tank",
            "safety.passivity",
            "safety.valves",
            "safety.stiffness_rate",
            "safety.kinetic_barrier",
            "safety.filters",
            "safety.filtered_law",
            "safety.filtered_drive",
            "safety.recorded_energy",
            "tasks.maze.maze",
            "tasks.maze.navigation",
        ),
    ],
    "perception": [
        *("perception.velocity", "perception.image_folder", "perception.rope.tracking"),
        *("perception.rope.nodes", "perception.rope.marker_observer"),
        *("perception.clouds", "perception.surfaces"),
        *("perception.visibility", "perception.surface_features", "perception.point_files"),
    ],
    "trials": [
        *("trials.trial", "trials.controller", "trials.audit", "trials.adversaries"),
        *("trials.rope.stabilization", "trials.rope.tracking"),
        *("trials.rope.learned", "trials.rope.baselines", "trials.rope.planners"),
        *("trials.furniture.namo_episode", "trials.furniture.cart_trials"),
        *("trials.appliance.hand", "trials.appliance.interaction", "trials.appliance.score"),
        *("trials.appliance.motion", "trials.appliance.surface_examples"),
    ],
    "deployment": [
        *("deployment.deployment", "deployment.supervisor", "deployment.intake"),
        *("deployment.decision", "deployment.loop", "deployment.transport"),
        *("deployment.messages", "deployment.plausibility", "deployment.onnx_export"),
        *("deployment.contract", "deployment.onnx_actor", "deployment.scaling"),
    ],
    "runs": [
        *("runs.run", "runs.result", "runs.progress", "runs.storage", "report.evidence"),
        *("report.page", "family", "errors"),
    ],
}


def calls() -> list[tuple[str, str, str]]:
    """Each command with what it works on, its module, and where its options are ("module:name")."""
    rows = []
    for name, command in COMMANDS.items():
        kinds = command.kinds(name)
        if command.options and command.subject:  # of experiments, all with the same options
            kinds = {command.subject.upper(): next(iter(kinds.values()))}
        rows += [(f"{name} {kind}".strip(), name, place) for kind, place in kinds.items()]
        rows += _own_call(name, command)
    return rows


def write_pages(folder: Path) -> None:
    """A Markdown file for each stage, and the table of calls."""
    folder.mkdir(parents=True, exist_ok=True)
    for stage, modules in STAGES.items():
        title = f"# {stage.capitalize()}\n"
        sections = map(_section, modules)
        (folder / f"{stage}.md").write_text("\n".join([title, *sections]))
    rows = ["| on the command line | in Python | with |", "|---|---|---|"]
    for words, name, place in calls():
        module, _, options = place.partition(":")
        run = f"{{func}}`{name}.run() <palpate.commands.{name}.run>`"
        made = f"`{options} <{module}.{options}>`"
        made = f"{{class}}{made}" if options[0].isupper() else f"what {{func}}{made} gives"
        rows.append(f"| `palpate {words}` | {run} | {made} |")
    (folder / "calls.md").write_text("\n".join(rows) + "\n")


def _section(name: str) -> str:
    members = ":members: run" if name.removeprefix("commands.") in COMMANDS else ":members:"
    bases = "   :show-inheritance:\n" if name.endswith("options") else ""
    shown = f".. automodule:: palpate.{name}\n   {members}\n{bases}"
    return f"## palpate.{name}\n\n```{{eval-rst}}\n{shown}```\n"


def _own_call(name: str, command: Command) -> list[tuple[str, str, str]]:
    return [(f"{name} FILE.py:CLASS", name, command.own)] if command.own else []
