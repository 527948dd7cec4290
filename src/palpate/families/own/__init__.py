"""What somebody has in a Python file: a model, a task; nothing of it is registered."""

from palpate.family import Family

FAMILY = Family(
    name="own",
    about="what you have written yourself, FILE.py:CLASS",
    experiments={"own-model": "palpate.experiments.own_model:reproduce"},
)
