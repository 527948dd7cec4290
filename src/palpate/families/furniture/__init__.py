"""Furniture: rigid bodies in the plane with wheels, pivots and contacts; a robot among them."""

from palpate.family import Family

_OPTIONS, _EXPERIMENTS = "palpate.families.furniture.options", "palpate.experiments.furniture"

FAMILY = Family(
    name="furniture",
    about="rigid bodies in the plane, wheels, pivots",
    models={"planar": "palpate.models.planar:Planar"},
    options={
        "record": {"furniture": f"{_OPTIONS}:RecordFurniture"},
        "identify": {"furniture": f"{_OPTIONS}:IdentifyFurniture"},
        "plan": {"namo": f"{_OPTIONS}:PlanNamo"},
    },
    experiments={
        "namo-scenarios": f"{_EXPERIMENTS}.namo_scenarios:reproduce",
        "namo-scaling": f"{_EXPERIMENTS}.namo_scaling:reproduce",
        "namo-online": f"{_EXPERIMENTS}.namo_online:reproduce",
        "calibration": f"{_EXPERIMENTS}.calibration:reproduce",
        "one-shot": f"{_EXPERIMENTS}.one_shot:reproduce",
        "cart-online": f"{_EXPERIMENTS}.cart_online:reproduce",
    },
)
