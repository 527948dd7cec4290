"""Files are whole or absent, and array trees come back as they were or not at all."""

import dataclasses
import json
import os
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import PalpateError
from palpate.runs.storage import (
    DamagedFileError,
    load_arrays,
    plain,
    read_json,
    read_manifest,
    save_arrays,
    write_bytes,
    write_json,
    write_text,
)

# --- text and JSON ----------------------------------------------------------------------------


def test_parents_are_created_and_nothing_is_left_beside_the_file(tmp_path):
    path = tmp_path / "a" / "b" / "note.txt"
    write_text(path, "élan")
    write_text(path, "vital")
    assert path.read_text(encoding="utf-8") == "vital"
    assert [entry.name for entry in path.parent.iterdir()] == ["note.txt"]


def test_a_write_that_fails_leaves_the_old_content(tmp_path, monkeypatch):
    path = tmp_path / "weights.bin"
    write_bytes(path, b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(PalpateError, match=r"cannot write .*weights.bin: No space left"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_writing_below_a_file_is_one_sentence(tmp_path):
    write_text(tmp_path / "file", "")
    with pytest.raises(PalpateError, match="cannot write"):
        write_text(tmp_path / "file" / "below", "")


def test_json_keeps_order_and_turns_arrays_into_lists(tmp_path):
    @dataclasses.dataclass
    class Settings:
        rate: float = 2.0
        out: Path = Path("runs/x")

    path = tmp_path / "x.json"
    value = {
        "z": np.float32(0.5),
        "a": jnp.arange(3),
        "m": (1, None, True, np.bool_(False)),
        "b": np.ones((1, 2), jnp.bfloat16),
        "settings": Settings(),
    }
    write_json(path, value)
    assert read_json(path) == {
        "z": 0.5,
        "a": [0, 1, 2],
        "m": [1, None, True, False],
        "b": [[1.0, 1.0]],
        "settings": {"rate": 2.0, "out": "runs/x"},
    }
    assert list(read_json(path)) == list(value)
    assert path.read_text().startswith('{\n  "z": 0.5,\n')


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"loss": {"tip": [1.0, float("nan")]}}, r"loss\.tip\[1\] is nan: expected a finite"),
        ({"limit": jnp.array(jnp.inf)}, "limit is inf"),
        ({"x": np.array([[0.0, -np.inf]])}, r"x\[0\]\[1\] is -inf"),
        ({"x": {1: 2}}, "x has the key 1: expected keys that are strings"),
        ({"x": {"f": print}}, r"x\.f is of type builtin_function_or_method: expected a dict"),
        ({"x": {1, 2}}, "x is of type set"),
        (float("nan"), "the value is nan"),
    ],
)
def test_what_json_cannot_hold_is_refused_by_its_key_path(tmp_path, value, message):
    with pytest.raises(PalpateError, match=message):
        write_json(tmp_path / "x.json", value)
    assert not list(tmp_path.iterdir())


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)  # fmt: skip


@given(json_values)
@settings(max_examples=50, deadline=None)
def test_plain_is_the_identity_on_json(value):
    assert plain(value) == value
    assert plain(json.loads(json.dumps(value))) == plain(value)


@pytest.mark.parametrize("text", ["", "{", '{"a": NaN}', "[1e999, Infinity]", "[" * 100_000])
def test_damaged_json_is_refused(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(DamagedFileError, match=r"x\.json is not valid JSON"):
        read_json(tmp_path / "x.json")


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "x.json").write_bytes(b"\xff\xfe\x00{")
    with pytest.raises(DamagedFileError, match="not valid JSON"):
        read_json(tmp_path / "x.json")


def test_a_missing_file_and_a_folder_are_told_apart(tmp_path):
    for read in (read_json, read_manifest):
        with pytest.raises(PalpateError, match="there is no file"):
            read(tmp_path / "none")
        with pytest.raises(PalpateError, match="is a folder: expected a file"):
            read(tmp_path)


# --- array trees ------------------------------------------------------------------------------


class Layer(eqx.Module):
    weight: jax.Array
    bias: np.ndarray
    activation: object
    dropout: float


def tree(seed: int = 0):
    generator = np.random.default_rng(seed)
    return {
        "layer": Layer(
            weight=jnp.asarray(generator.normal(size=(3, 4)), jnp.float32),
            bias=generator.normal(size=4),
            activation=jnp.tanh,
            dropout=0.1 + seed,
        ),
        "half": jnp.asarray(generator.normal(size=2), jnp.bfloat16),
        "key": jax.random.key(seed),
        "keys": jax.random.split(jax.random.key(seed, impl="rbg"), 2),
        "count": seed,
        "done": bool(seed),
        "best": np.float32(seed),
        "nothing": (None, "text", []),
        "empty": jnp.zeros((0, 3)),
    }


def same(left, right):
    def raw(leaf):
        return np.asarray(
            jax.random.key_data(leaf) if eqx.is_array(leaf) and is_key(leaf) else leaf
        )

    def is_key(leaf):
        return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)

    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return all(
        type(a) is type(b) and raw(a).dtype == raw(b).dtype and np.array_equal(raw(a), raw(b))
        for a, b in pairs
    )


def test_a_tree_comes_back_leaf_by_leaf(tmp_path):
    path = tmp_path / "x.safetensors"
    manifest = {"units": {"weight": "N/m"}, "rate": 100}
    save_arrays(path, tree(1), manifest)
    restored, found = load_arrays(path, tree(0))
    assert found == manifest == read_manifest(path)
    assert same(restored, tree(1))
    assert not same(tree(0), tree(1))
    assert restored["layer"].activation is jnp.tanh
    assert jax.random.uniform(restored["key"]) == jax.random.uniform(tree(1)["key"])
    restored["layer"].bias[0] = 7.0  # NumPy leaves are ordinary writable arrays


def test_names_are_readable_and_foreign_readers_can_open_the_file(tmp_path):
    from safetensors.numpy import load_file

    save_arrays(tmp_path / "x.safetensors", tree(), {})
    arrays = load_file(tmp_path / "x.safetensors")
    assert {"layer.weight", "layer.bias", "count", "key"} <= arrays.keys()
    np.testing.assert_array_equal(arrays["layer.weight"], tree()["layer"].weight)


def test_a_single_array_and_a_transposed_one(tmp_path):
    matrix = np.arange(6.0).reshape(2, 3).T[::-1]
    save_arrays(tmp_path / "x.safetensors", matrix, {})
    restored, _ = load_arrays(tmp_path / "x.safetensors", np.zeros((3, 2)))
    np.testing.assert_array_equal(restored, matrix)


def test_a_number_that_became_an_array_under_jit_comes_back_as_a_number(tmp_path):
    state = {"count": 0, "best": 1.5, "done": False}
    save_arrays(tmp_path / "x.safetensors", jax.jit(lambda s: s)(state), {})
    restored, _ = load_arrays(tmp_path / "x.safetensors", state)
    assert restored == state
    kinds = {name: type(leaf) for name, leaf in restored.items()}
    assert kinds == {"count": int, "best": float, "done": bool}


def test_shapes_alone_are_enough_to_load(tmp_path):
    path = tmp_path / "x.safetensors"

    def make(key):
        return {"mlp": eqx.nn.MLP(2, 2, 4, 1, key=key), "key": key}

    saved = make(jax.random.key(3))
    save_arrays(path, saved, {})
    restored, _ = load_arrays(path, eqx.filter_eval_shape(make, jax.random.key(0)))
    assert eqx.tree_equal(restored, saved)


def test_the_same_tree_gives_the_same_bytes(tmp_path):
    for name in "abcdefgh":
        save_arrays(tmp_path / name, tree(2), {"b": 1, "a": 2})
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


@pytest.mark.parametrize(
    ("saved", "like", "message"),
    [
        ({"a": jnp.zeros(3)}, {"a": jnp.zeros((3, 1))},
         r"leaf 'a' of .*: expected float32 \(3, 1\), the file has float32 \(3,\)"),
        ({"a": jnp.zeros(3)}, {"a": jnp.zeros(3, int)}, r"expected int32 \(3,\), .* float32"),
        ({"a": jnp.zeros(3)}, {"b": jnp.zeros(3)}, "lacks 'b' and has besides 'a'"),
        ({"a": jnp.zeros(3)}, {"a": jnp.zeros(3), "c": 1}, "expected: lacks 'c'"),
        ({str(i): i for i in range(9)}, {}, "has besides '0', '1', '2', '3' and 5 more"),
        ({"n": 1}, {"n": 1.0}, r"leaf 'n' of .*: expected float64 \(\), the file has int64 \(\)"),
        ({"k": jax.random.key(0)}, {"k": jax.random.PRNGKey(0)},
         r"expected uint32 \(2,\), the file has key<fry> \(\)"),
        ({"k": jax.random.PRNGKey(0)}, {"k": jax.random.key(0)},
         r"expected key<fry> \(\), the file has uint32 \(2,\)"),
        ({"k": jax.random.key(0)}, {"k": jax.random.key(0, impl="rbg")},
         r"expected key<rbg> \(\), the file has key<fry> \(\)"),
    ],
)  # fmt: skip
def test_a_tree_that_does_not_fit_is_refused_by_name(tmp_path, saved, like, message):
    path = tmp_path / "x.safetensors"
    save_arrays(path, saved, {})
    with pytest.raises(PalpateError, match=message) as caught:
        load_arrays(path, like)
    assert not isinstance(caught.value, DamagedFileError)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"w": np.array(["text"])}, "leaf 'w' is of dtype <U4: expected one of bfloat16, bool"),
        ({"w": np.array([object()])}, "leaf 'w' is of dtype object"),
        ({"w": np.zeros(2, complex)}, "leaf 'w' is of dtype complex128"),
        ({"a": {"b": 1}, "a.b": 2}, "two leaves named 'a.b'"),
    ],
)
def test_what_cannot_be_stored_is_refused_before_anything_is_written(tmp_path, bad, message):
    with pytest.raises(PalpateError, match=message):
        save_arrays(tmp_path / "x.safetensors", bad, {})
    assert not list(tmp_path.iterdir())


def test_every_truncation_and_every_flipped_byte_is_noticed(tmp_path):
    path = tmp_path / "x.safetensors"
    small = {"a": jnp.arange(3.0), "key": jax.random.key(1)}
    save_arrays(path, small, {"step": 3})
    whole = path.read_bytes()
    for length in range(0, len(whole), 3):
        path.write_bytes(whole[:length])
        with pytest.raises(DamagedFileError):
            load_arrays(path, small)
    for position in range(len(whole)):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :])
        try:
            restored, manifest = load_arrays(path, small)
        except PalpateError:
            continue
        # a flip in the padding of the header changes nothing
        assert same(restored, small)
        assert manifest == {"step": 3}


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04" + bytes(64), b"\xff" * 64])
def test_other_kinds_of_files_are_refused(tmp_path, content):
    path = tmp_path / "x.safetensors"
    path.write_bytes(content)
    for read in (lambda: load_arrays(path, {}), lambda: read_manifest(path)):
        with pytest.raises(DamagedFileError, match="damaged or not a safetensors file"):
            read()


def test_safetensors_of_other_programs_are_refused(tmp_path):
    from safetensors.numpy import save_file

    path = tmp_path / "x.safetensors"
    save_file({"a": np.zeros(3)}, path)
    with pytest.raises(PalpateError, match="not written by palpate") as caught:
        load_arrays(path, {"a": np.zeros(3)})
    assert not isinstance(caught.value, DamagedFileError)
    save_file({"a": np.zeros(3)}, path, metadata={"palpate": "[]"})
    with pytest.raises(DamagedFileError, match="header lacks manifest"):
        read_manifest(path)
