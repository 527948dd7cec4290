"""Environments of Gymnasium that somebody else wrote, and what may be learnt in them."""

from palpate.family import Family

_OPTIONS = "palpate.families.gymnasium.options"

FAMILY = Family(
    name="gymnasium",
    about="environments of Gymnasium, anybody's",
    options={
        "train": {"gymnasium": f"{_OPTIONS}:TrainGymnasium"},
        "evaluate": {"gymnasium": f"{_OPTIONS}:EvaluateGymnasium"},
    },
    experiments={"velocity-yardstick": "palpate.experiments.velocity_yardstick:reproduce"},
)
