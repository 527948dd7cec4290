"""Contact: a compliant tip that feels its way."""

from palpate.family import Family

_MAZE = "palpate.families.contact.maze_options"
_NAVIGATION = "palpate.families.contact.navigation_options"
_TOUCH = "palpate.families.contact.touch_options"

FAMILY = Family(
    name="contact",
    about="a compliant tip that touches walls",
    models={"tip": "palpate.models.contact:Tip"},
    deployments={
        "maze": "palpate.families.contact.deployment:MazeDeployment",
        "navigation": "palpate.families.contact.deployment:NavigationDeployment",
    },
    options={
        "record": {"contact": f"{_TOUCH}:RecordContact"},
        "identify": {"contact": f"{_TOUCH}:IdentifyContact"},
        "train": {"maze": f"{_MAZE}:TrainMaze", "navigation": f"{_NAVIGATION}:TrainNavigation"},
        "evaluate": {
            "maze": f"{_MAZE}:EvaluateMaze",
            "navigation": f"{_NAVIGATION}:EvaluateNavigation",
        },
    },
    experiments={
        "maze-safe": "palpate.experiments.contact.maze_safe:reproduce",
        "contact-model": "palpate.experiments.contact.contact_model:reproduce",
        "maze-arm": "palpate.experiments.contact.maze_arm:reproduce",
        "maze-reflex": "palpate.experiments.contact.maze_reflex:reproduce",
        "energy-audit": "palpate.experiments.contact.energy_audit:reproduce",
        "maze-passive": "palpate.experiments.contact.maze_passive:reproduce",
    },
)
