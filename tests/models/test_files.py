"""Models on disk: what comes back, and what a damaged file is told."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.files import load_model, save_model
from palpate.models.planar import furniture
from palpate.models.planar.shapes import rectangle
from palpate.models.rope import Rope
from palpate.parameters import declare, parameters_of, value_of, with_values
from toys import Cart

REMOVED = object()

KNOWN = "there are: articulated, tip, planar, rope"
AGAIN = "; identify the model again if another version of palpate or of its class wrote the file"


def rope() -> Rope:
    """Nothing in it is a default, and no two elements are equal."""
    rng = np.random.default_rng(0)
    return Rope.from_rest_lengths(
        rng.uniform(0.08, 0.12, 5), 0.07, bend_stiffness=rng.uniform(0.01, 0.02, 4),
        rest_bend=rng.normal(size=(4, 3)), gravity=9.7, driven=(0, 1, 5), drive="position",
        control_period=0.008, substeps=9,
    )  # fmt: skip


@pytest.fixture
def file(tmp_path):
    save_model(tmp_path / "model.json", rope(), {"recordings": ["one.npz"], "error": 0.01})
    return tmp_path / "model.json"


def test_a_model_comes_back_as_it_was_saved(file):
    model, about = load_model(file)
    assert type(model) is Rope
    for path in parameters_of(model):
        ours, saved = value_of(model, path), value_of(rope(), path)
        assert ours.dtype == saved.dtype
        np.testing.assert_array_equal(ours, saved)
    assert jax.tree.structure(model) == jax.tree.structure(rope())  # drive, driven, times
    assert about == {"recordings": ["one.npz"], "error": 0.01}


def test_a_file_tells_a_person_unit_and_meaning_of_every_parameter(file):
    rows = {row["name"]: row for row in json.loads(file.read_text())["parameters"]}
    assert set(rows) == set(parameters_of(Rope))
    assert rows["bend_stiffness"]["unit"] == "N m/rad"
    assert "restoring torque" in rows["bend_stiffness"]["about"]


def test_an_undamped_model_comes_back_and_what_was_declared_differently_does_not(tmp_path):
    undamped = {
        name: 0.0
        for name in ("stretch_damping", "bend_damping", "grip_damping", "air_drag")
    }  # fmt: skip
    model = declare(Rope.uniform(nodes=5, **undamped), bend_damping={"fixed": True})
    save_model(tmp_path / "model.json", model)
    loaded, about = load_model(tmp_path / "model.json")
    assert about == {}
    assert not np.any(loaded.bend_damping)
    assert loaded.overrides == ()


def test_furniture_comes_back_with_its_structure(tmp_path):
    box = rectangle(1.0, 0.5)
    poses = np.array([[0.0, 0.0, 0.3], [2.0, 0.0, 0.0]])
    for model in (
        furniture([box, box], [box + 5.0], pivots={0: 1}, bolted=[1], mass=[3.0, 4.0], poses=poses),
        furniture([box], law="viscous", control_period=0.01, substeps=2),  # no walls, no links
    ):
        save_model(tmp_path / "model.json", model)
        loaded, _ = load_model(tmp_path / "model.json")
        assert jax.tree.structure(loaded) == jax.tree.structure(model)
        state = model.initial_state(jnp.asarray(poses[None, : model.bodies]))
        push = jnp.full(model.action_shape, 20.0)
        # compiled once for both, if all that is not an array is the same too
        step = eqx.filter_jit(lambda one, state, push: one.step(state, push).velocity)
        np.testing.assert_array_equal(step(loaded, state, push), step(model, state, push))
        for ours, saved in zip(jax.tree.leaves(loaded), jax.tree.leaves(model), strict=True):
            assert ours.dtype == saved.dtype
            np.testing.assert_array_equal(ours.ravel(), saved.ravel())  # no walls: of no corners


@pytest.mark.parametrize(
    ("place", "to", "text"),
    [
        (("structure", "bolted"), [0, 0, 1], "bolted must have the axes (bodies) of 2 bodies, "
         "1 wheels, 0 links, got shape (3,)"),
        (("value", "centre_of_mass"), [[0.3], [0.3]], "centre_of_mass must have the axes "
         "(bodies, 2) of 2 bodies, 1 wheels, 0 links, got shape (2, 1)"),
        (("structure", "pairs"), [[0, 0, 2, 0]], "pairs names number 2: there are -1 to 1"),
        (("structure", "pairs"), [[0, 0, -1, 0]], "pairs names number 0: there are 0 to -1"),
    ],
)  # fmt: skip
def test_furniture_that_does_not_fit_itself_is_refused(tmp_path, place, to, text):
    path = tmp_path / "model.json"
    save_model(path, furniture([rectangle(1.0, 0.5)] * 2))
    assert refusal(changed(path, *place, to=to)) == f"FILE is damaged: {text}"


def test_structure_that_is_no_numbers_is_refused(tmp_path):
    path = tmp_path / "model.json"
    save_model(path, furniture([rectangle(1.0, 0.5)]))
    assert refusal(changed(path, "structure", "bolted", to="no")) == (
        "'bolted' in FILE is not numbers: 'no'"
    )


def test_a_batch_of_models_is_not_saved(tmp_path):
    model = furniture([rectangle(1.0, 0.5)])
    batch = with_values(model, {"mass": jnp.ones((3, 1))})
    with pytest.raises(PalpateError, match="one model, not a batch"):
        save_model(tmp_path / "model.json", batch)
    assert not (tmp_path / "model.json").exists()


def test_a_model_that_nobody_could_read_again_is_not_saved(tmp_path):
    class Hidden(Cart):
        """Nobody finds a class inside a function by its name."""

    with pytest.raises(PalpateError) as error:
        save_model(tmp_path / "model.json", Hidden(1.0, 0.5))
    assert str(error.value) == (
        "a model of type Hidden cannot be saved: expected a class at the top of a Python file, or "
        "one of articulated, tip, planar, rope"
    )
    assert not (tmp_path / "model.json").exists()


def refusal(path) -> str:
    with pytest.raises(PalpateError) as error:
        load_model(path)
    sentence = str(error.value)
    assert "\n" not in sentence
    assert sentence.count(str(path)) <= 1
    return sentence.replace(str(path), "FILE")


def changed(file, *place, to):
    """The file with one entry replaced or removed; a parameter's value by its name."""
    content = json.loads(file.read_text())
    if place[0] == "value":
        place = ("parameters", [r["name"] for r in content["parameters"]].index(place[1]), "value")
    entry = content
    for key in place[:-1]:
        entry = entry[key]
    if to is REMOVED:
        del entry[place[-1]]
    else:
        entry[place[-1]] = to
    file.write_text(json.dumps(content))
    return file


def test_no_file_a_folder_and_a_cut_off_file_are_refused(file, tmp_path):
    assert refusal(tmp_path / "none.json") == "there is no file FILE"
    assert refusal(tmp_path) == "FILE is a folder: expected a file"
    text = file.read_text()
    for length in (0, 1, len(text) // 2, len(text) - 3):
        file.write_text(text[:length])
        assert refusal(file).startswith("FILE is not valid JSON: ")
    file.write_bytes(b"\x80\x04\x95 a pickle")
    assert refusal(file).startswith("FILE is not valid JSON: ")


@pytest.mark.parametrize("text", ["[]", "3", "null", '{"format": "palpate.run"}', "{}"])
def test_other_json_is_no_model(file, text):
    file.write_text(text)
    assert refusal(file) == (
        "FILE is not a model: expected a JSON file written by `palpate identify`"
    )


@pytest.mark.parametrize(
    ("place", "to", "text"),
    [
        (("version",), 3, "FILE has version 3; this palpate reads versions 1 and 2"),
        (("version",), [1], "FILE has version [1]; this palpate reads versions 1 and 2"),
        (("version",), True, "FILE has version True; this palpate reads versions 1 and 2"),
        (("version",), REMOVED, "FILE has version None; this palpate reads versions 1 and 2"),
        (("model",), "string", f"FILE holds the unknown model 'string'; {KNOWN}"),
        (("model",), ["rope"], f"FILE holds the unknown model '['rope']'; {KNOWN}"),
        (("model",), REMOVED, f"FILE holds the unknown model 'None'; {KNOWN}"),
        (
            ("value", "node_mass"),
            [-0.01, *[0.01] * 5],
            "'node_mass' in FILE must not be negative, got -0.01",
        ),
        (("value", "air_drag"), -1, "'air_drag' in FILE must not be negative, got -1"),
        (("value", "rest_length"), [0.1, None, 0.1], "'rest_length' in FILE is not finite"),
        (("value", "gravity"), 1e60, "'gravity' in FILE is not finite"),  # not in float32
        (("value", "gravity"), "strong", "'gravity' in FILE is not numbers: 'strong'"),
        (("value", "gravity"), {}, "'gravity' in FILE is not numbers: {}"),
        (
            ("value", "rest_bend"),
            [[0.0], [0.0, 0.0]],
            "'rest_bend' in FILE is not numbers: [[0.0], [0.0, 0.0]]",
        ),
        (
            ("value", "bend_damping"),
            [1e-3] * 3,
            "FILE is damaged: "
            "bend_damping of a rope of 6 nodes must have 4 elements, got shape (3,)",
        ),
        (
            ("value", "rest_bend"),
            [[0.0] * 3] * 5,
            "FILE is damaged: "
            "rest_bend of a rope of 6 nodes must have the shape (4, 3), got (5, 3)",
        ),
        (("value", "air_drag"), [1, 2], "'air_drag' in FILE must be one number, got shape (2,)"),
        (
            ("value", "node_mass"),
            0.1,
            "'node_mass' in FILE must be the axes (nodes), got shape ()",
        ),
        (
            ("value", "rest_bend"),
            [0.0] * 4,
            "'rest_bend' in FILE must be the axes (joints, 3), got shape (4,)",
        ),
        (
            ("structure", "driven"),
            [0, 6],
            "FILE is damaged: driven nodes must lie in 0 to 5 and be at least one, got (0, 6)",
        ),
        (
            ("structure", "substeps"),
            REMOVED,
            "the structure in FILE do not fit: missing ['substeps'], unknown none" + AGAIN,
        ),
        (
            ("structure", "colour"),
            "red",
            "the structure in FILE do not fit: missing none, unknown ['colour']" + AGAIN,
        ),
        (
            ("parameters", 0),
            REMOVED,
            "the parameters in FILE do not fit: missing ['node_mass'], unknown none" + AGAIN,
        ),
        (
            ("parameters", 0, "name"),
            "weight",
            "the parameters in FILE do not fit: missing ['node_mass'], unknown ['weight']" + AGAIN,
        ),
    ],
)  # fmt: skip
def test_a_damaged_entry_is_named(file, place, to, text):
    assert refusal(changed(file, *place, to=to)) == text


@pytest.mark.parametrize(
    ("place", "to"),
    [
        (("parameters",), REMOVED),
        (("parameters",), {"gravity": 9.81}),
        (("parameters", 0, "name"), REMOVED),
        (("parameters", 0, "name"), ["node_mass"]),
        (("structure",), REMOVED),
        (("structure",), ["driven"]),
        (("about",), REMOVED),
        (("about",), 3),
    ],
)
def test_a_file_without_its_parts_is_damaged(file, place, to):
    assert refusal(changed(file, *place, to=to)) == (
        "FILE is damaged: its parameters or structure are missing"
    )


@pytest.mark.parametrize(
    ("name", "to", "text"),
    [
        ("control_period", "fast", "such as 0.01, got 'fast'"),
        ("control_period", [0.01], "such as 0.01, got (0.01,)"),
        ("substeps", None, "such as 10, got None"),
        ("substeps", 2.5, "such as 10, got 2.5"),
        ("substeps", True, "such as 10, got True"),
        ("driven", 0, "such as (0,), got 0"),
        ("driven", ["first"], "such as (0,), got ('first',)"),
        ("driven", [[0]], "such as (0,), got ([0],)"),
        ("drive", 3, "such as 'velocity', got 3"),
    ],
)
def test_structure_of_another_kind_is_refused(file, name, to, text):
    assert refusal(changed(file, "structure", name, to=to)) == f"'{name}' in FILE must be {text}"


def test_a_whole_number_of_seconds_is_a_number(file):
    model, _ = load_model(changed(file, "structure", "control_period", to=1))
    assert model.control_period == 1


def test_not_a_number_is_refused_however_it_is_spelled(file):
    text = file.read_text()
    for spelling in ("NaN", "Infinity", "-Infinity"):
        file.write_text(text.replace("9.69", spelling + ", 9.69", 1))
        assert refusal(file).startswith("FILE is not valid JSON: ")
    content = json.loads(text)
    place = [row["name"] for row in content["parameters"]].index("gravity")
    content["parameters"][place]["value"] = "OVERFLOW"
    file.write_text(json.dumps(content).replace('"OVERFLOW"', "1e999"))
    assert refusal(file) == "'gravity' in FILE is not finite"
