"""What `palpate train` says of a policy in the end."""

import pytest

from palpate.commands import train
from palpate.runs import Figure


@pytest.mark.parametrize(
    ("inside", "outside", "said"),
    [
        (0.9, 0.75, ""),
        (0.9, None, ""),
        (None, None, ""),
        (0.12, 0.0, "in its own model the policy succeeds in 12% of the starts: expected at least"),
        (0.9, 0.25, "in 90% of the starts in its own model and in 25% of a few trials in a sim"),
    ],
)
def test_a_poor_policy_is_warned_of(inside, outside, said):
    values = {"in_model.success": inside, "in_world.success_rate": outside}
    figures = [Figure(name, value, "") for name, value in values.items() if value is not None]
    assert bool(said) == bool(train.warnings_of(figures))
    assert said in " ".join(train.warnings_of(figures))


@pytest.mark.parametrize(
    ("inside", "outside", "said"),
    [
        (0.9, 0.75, "succeeds in 90 % of the starts. In a few trials in a simulated world it succ"),
        (1.0, None, "in 100 % of the starts. Nothing but that model was tried."),
        (None, None, "Nothing but that model was tried."),
        (
            0.12,
            0.0,
            "in 12 % of the starts. In a few trials in a simulated world it succeeds in 0 ",
        ),
        (0.12, 0.0, "it is not to be trusted yet."),
    ],
)
def test_the_page_says_in_two_sentences_what_was_trained(inside, outside, said):
    values = {"in_model.success": inside, "in_world.success_rate": outside}
    figures = [Figure(name, value, "") for name, value in values.items() if value is not None]
    assert said in " ".join(train.summary_of(figures, train.warnings_of(figures)))
