"""Contact: a compliant tip that feels its way."""

from palpate.family import Family

FAMILY = Family(
    name="contact",
    about="a compliant tip that touches walls",
    models={"tip": "palpate.models.contact:Tip"},
)
