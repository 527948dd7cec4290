"""Contact: a compliant tip that feels its way."""

from palpate.family import Family

_TOUCH = "palpate.families.contact.touch_options"

FAMILY = Family(
    name="contact",
    about="a compliant tip that touches walls",
    models={"tip": "palpate.models.contact:Tip"},
    options={
        "record": {"contact": f"{_TOUCH}:RecordContact"},
        "identify": {"contact": f"{_TOUCH}:IdentifyContact"},
    },
    experiments={
        "contact-model": "palpate.experiments.contact.contact_model:reproduce",
    },
)
