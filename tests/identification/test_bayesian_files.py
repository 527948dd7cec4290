"""A posterior is read back as it was written, and ArviZ gets what it needs."""

import builtins
import contextlib
import dataclasses

import jax
import numpy as np
import pytest

from bayesian_toys import Sled, pushes
from palpate.errors import PalpateError
from palpate.identification.posterior.comparison import posterior_of
from palpate.identification.posterior.files import (
    read_models,
    read_posterior,
    to_arviz,
    write_netcdf,
    write_posterior,
)
from palpate.identification.posterior.posterior import sample
from palpate.runs.storage import DamagedFileError


@pytest.fixture(scope="module")
def posterior():
    model = Sled(mass=10.0, friction=[15.0, 15.0])
    recording = pushes(Sled(mass=14.0, friction=[6.0, 40.0]), 1, trials=2, frames=51)
    return sample(posterior_of(model, recording, seconds=1.0), chains=2, draws=50)


def test_what_was_written_is_read_back(posterior, tmp_path):
    path = write_posterior(tmp_path / "posterior.npz", posterior)
    arrays, about = read_posterior(path)
    np.testing.assert_array_equal(arrays["position"], posterior.draws.position)
    np.testing.assert_array_equal(arrays["value.friction"], posterior.values["friction"])
    assert about["names"] == list(posterior.target.names)
    assert [row["name"] for row in about["table"]] == about["names"]
    assert about["warnings"] == list(posterior.warnings)


def test_models_come_back_and_predict_the_same(posterior, tmp_path, toys):
    path = write_posterior(tmp_path / "posterior.npz", posterior)
    for count in (None, 7):
        ours, written = read_models(path, count), posterior.models(count)
        assert jax.tree.structure(ours) == jax.tree.structure(written)
        for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(written), strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_more_complete_model_may_be_kept(posterior, tmp_path, toys):
    reference = posterior.target.coordinates.reference
    other = dataclasses.replace(reference, control_period=2 * reference.control_period)
    path = write_posterior(tmp_path / "posterior.npz", posterior, other)
    models = read_models(path)
    assert models.control_period == other.control_period
    np.testing.assert_array_equal(models.mass, posterior.models().mass)


def test_draws_of_a_model_of_somebodys_own_need_its_class(posterior, tmp_path):
    path = write_posterior(tmp_path / "posterior.npz", posterior)
    with pytest.raises(PalpateError, match=r"holds a model of 'bayesian_toys.py:Sled'"):
        read_models(path)
    np.testing.assert_array_equal(read_models(path, kind=Sled).mass, posterior.models().mass)


def test_draws_that_do_not_fit_their_model_are_refused(posterior, tmp_path, toys):
    path = write_posterior(tmp_path / "posterior.npz", posterior)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{name: value for name, value in arrays.items() if name != "value.mass"})
    with pytest.raises(DamagedFileError, match="missing \\['mass'\\]"):
        read_models(path)
    np.savez(path, **arrays | {"value.mass": np.full_like(arrays["value.mass"], np.nan)})
    with pytest.raises(DamagedFileError, match=r"'mass' in .* is not finite"):
        read_models(path)
    with pytest.raises(PalpateError, match="at least one draw"):
        read_models(path, 0)
    np.savez(path, **arrays | {"value.mass": arrays["value.mass"][:1]})
    with pytest.raises(DamagedFileError, match="not of one length"):
        read_models(path)


def test_other_files_are_refused(posterior, tmp_path):
    with pytest.raises(PalpateError, match="there is no file"):
        read_posterior(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(PalpateError, match="is no posterior"):
        read_posterior(tmp_path / "other.npz")
    path = write_posterior(tmp_path / "cut.npz", posterior)
    whole = path.read_bytes()
    path.write_bytes(whole[:200])
    with pytest.raises(DamagedFileError):
        read_posterior(path)
    for place in range(60, 400, 20):  # a flipped byte: zlib's complaint, or the archive's
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        with contextlib.suppress(DamagedFileError, PalpateError):
            read_posterior(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DamagedFileError):
        read_posterior(path)


def test_arviz_gets_chains_and_predictions(posterior, tmp_path):
    arviz = pytest.importorskip("arviz")
    data = to_arviz(posterior)
    assert data.posterior["friction"].shape == (2, 50, 2)
    assert data.posterior["probe_end"].shape == (2, 50, 2, 3)
    path = write_netcdf(tmp_path / "posterior.nc", posterior)
    again = arviz.from_netcdf(path)
    np.testing.assert_allclose(again.posterior["mass"], posterior.values["mass"])


def test_without_arviz_the_extra_is_named(posterior, monkeypatch):
    present = builtins.__import__

    def without(name, *rest, **more):
        if name == "arviz":
            raise ImportError(name)
        return present(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(PalpateError, match="extra 'bayes'"):
        to_arviz(posterior)
