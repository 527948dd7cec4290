"""Appliances: things with doors, lids and drawers."""

from palpate.family import Family

FAMILY = Family(
    name="appliance",
    about="what has doors, lids and drawers",
    models={"articulated": "palpate.models.articulated:Articulated"},
    options={
        "record": {"appliance": "palpate.families.appliance.options:RecordAppliance"},
        "identify": {"appliance": "palpate.families.appliance.options:IdentifyAppliance"},
    },
    experiments={
        "articulated-model": "palpate.experiments.appliance.articulated_model:reproduce",
        "twin-interactive": "palpate.experiments.appliance.twin_interactive:reproduce",
        "movable-surfaces": "palpate.experiments.appliance.movable_surfaces:reproduce",
        "twin-foreign": "palpate.experiments.appliance.twin_foreign:reproduce",
    },
)
