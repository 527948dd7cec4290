"""A family from outside goes through every command, and nothing in the package knows it."""

from importlib.metadata import EntryPoint

import jax.numpy as jnp
import numpy as np
import pytest

from palpate import family
from palpate.cli import main
from palpate.networks import load_policy
from palpate.report import read_evidence
from palpate.runs.result import read_result
from toy_pendulum import PendulumWorld


@pytest.fixture(scope="module", autouse=True)
def workshop(tmp_path_factory):
    """A folder with a recording, an identified model and a policy, each by its command."""
    with pytest.MonkeyPatch.context() as patch:
        point = EntryPoint("toys", "toy_family:FAMILY", family.GROUP)
        patch.setattr(family, "entry_points", lambda group: [point])
        patch.chdir(tmp_path_factory.mktemp("workshop"))
        family.families.cache_clear()
        do("record toy-pendulum --trials 3 --duration 2 --out R.npz")
        do("identify toy-pendulum R.npz --method levenberg-marquardt --out model")
        size = "--iterations 60 --batch 16 --starts 64"
        do(f"train pendulum-damping --model model {size} --out policy")
        yield
    family.families.cache_clear()


def do(words):
    assert main(words.split()) == 0


def figures(folder):
    return {figure.name: figure.value for figure in read_result(f"{folder}/result.json").figures}


def test_what_is_identified_is_the_pendulum_that_was_recorded():
    rows = {row["name"]: row for row in read_result("model/result.json").parameters}
    for name, true in (("length", 0.7), ("damping", 0.4)):
        row = rows[name]
        assert row["lower"] < true < row["upper"], row
        assert row["upper"] - row["lower"] < 0.05 * true, row


def test_the_policy_does_better_than_nothing_in_the_world(capsys):
    do("evaluate pendulum-damping --policy policy --model model --out tried")
    table = capsys.readouterr().out.splitlines()
    assert table[0].startswith("controlled")
    assert table[1].startswith("held still")
    found = figures("tried")
    assert found["success_rate"] > 0.8
    assert found["success_rate.held_still"] < 0.2
    assert found["in_model.success"] > 0.8
    swing = read_evidence("tried").pieces["swing"]
    ends = {label: np.abs(angle[-50:]).max() for label, angle in swing.values.items()}
    assert ends["controlled"] < 0.2 * ends["held still"]


def test_what_is_exported_brings_the_pendulum_to_rest_as_the_policy_does():
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    do("export policy --onnx pendulum.onnx")
    session = runtime.InferenceSession("pendulum.onnx")
    policy, _ = load_policy("policy/policy.safetensors")
    world = PendulumWorld(0.7, 0.1)
    before = world.reset(3).angle
    carry, energy = np.zeros((1, 1), np.float32), world.truth().energy
    for _ in range(200):
        angle = world.step(carry[0]).angle
        rate = (angle - before) / world.control_period
        before = angle
        features = np.concatenate([np.sin(angle), np.cos(angle), rate]).astype(np.float32)
        expected, _ = policy(jnp.asarray(carry[0]), jnp.asarray(features), None, None)
        (carry,) = session.run(["command"], {"features": features[None], "carry": carry})
        np.testing.assert_allclose(carry[0], expected, atol=1e-5)
    assert world.truth().energy < 0.02 * energy


def test_the_page_tells_of_all_and_of_what_the_family_adds():
    do("evaluate pendulum-damping --policy policy --out again --pendulums 1")
    do("report model policy again --out page.html --title Toys")
    with open("page.html", encoding="utf-8") as file:
        page = file.read()
    assert all(f"<h2>{part}</h2>" in page for part in ("Results", "Parameters", "Learning"))
    assert "RMSE (rad)" in page
    assert "<h2>Swing</h2>" in page
    assert "The angle from hanging" in page


@pytest.mark.parametrize("words", ["record toy-pendulum", "train pendulum-damping"])
def test_help_knows_the_family(words, capsys):
    do(f"{words} --help")
    assert capsys.readouterr().out.startswith(f"usage: palpate {words}")
