"""A posterior on disk: our own NPZ with JSON, and ArviZ's NetCDF for whoever works with that."""

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.posterior.posterior import Posterior, spread_out
from palpate.models.files import build, file_of, kind_name, kind_of, structure_of
from palpate.models.model import Model
from palpate.parameters import parameters_of
from palpate.runs.storage import DamagedFileError, parse_json, plain, write_bytes

FORMAT = "palpate-posterior-1"
_ABOUT = "about"  # the entry that holds JSON as text


def write_posterior(path: str | Path, posterior: Posterior, model: Model | None = None) -> Path:
    """Write draws in whitened coordinates and in units, with what they are, as one NPZ file.

    Arrays: `position` (chains, draws, free), `density` (chains, draws), `value.PATH` (chains,
    draws, ...) for each free parameter, and `model.FIELD` for the arrays that the model is made of
    besides: of `model`, if one is given that is more complete than what was fitted. `about`: JSON
    with names, the table, warnings and cost, what the model is called, and its other settings.
    """
    draws = posterior.draws
    arrays: dict[str, np.ndarray] = {"position": draws.position, "density": draws.density}
    arrays |= {f"value.{path}": value for path, value in posterior.values.items()}
    whole: Model = posterior.target.coordinates.reference if model is None else model
    kind, settings = kind_name(whole), {}
    if kind is not None:
        fields = {*parameters_of(whole), *structure_of(type(whole))} - set(posterior.values)
        of = {name: getattr(whole, name) for name in fields}
        settings = {name: value for name, value in of.items() if not isinstance(value, jax.Array)}
        arrays |= {f"model.{name}": np.asarray(of[name]) for name in fields - set(settings)}
    about = {
        "format": FORMAT,
        "model": kind,
        **({"sha256": source[1]} if (source := file_of(whole)) else {}),
        "settings": settings,
        "names": list(posterior.target.names),
        "table": [vars(row) for row in posterior.table],
        "warnings": list(posterior.warnings),
        "rhat_of_predictions": posterior.rhat_of_predictions,
        "size_of_predictions": posterior.size_of_predictions,
        "acceptance": draws.acceptance,
        "divergences": draws.divergences,
        "evaluations": draws.evaluations,
        "seconds": draws.seconds,
    }
    arrays[_ABOUT] = np.array(json.dumps(plain(about)))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    path = Path(path)
    write_bytes(path, buffer.getvalue())
    return path


def read_posterior(path: str | Path) -> tuple[dict[str, Float[np.ndarray, "..."]], dict[str, Any]]:
    """Arrays and description that `write_posterior` wrote; nothing is unpickled.

    Raises `PalpateError` when the file is missing or no posterior, `DamagedFileError` when it is
    damaged.
    """
    try:
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = parse_json(str(arrays.pop(_ABOUT)))
    except FileNotFoundError as error:
        raise PalpateError(f"there is no file {path}") from error
    except KeyError as error:
        raise PalpateError(f"{path} is no posterior: expected that of write_posterior") from error
    except (OSError, ValueError, EOFError, TypeError, zlib.error, zipfile.BadZipFile) as error:
        raise DamagedFileError(f"{path} is damaged or no NPZ file ({error})") from error
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise PalpateError(f"{path} is no posterior of the format {FORMAT}")
    return arrays, about


def read_models(
    path: str | Path, count: int | None = None, kind: type[Model] | None = None
) -> Model:
    """The models that `write_posterior` wrote, as one whose free parameters lead with the draws.

    All draws of all chains, or about `count` (at least one) evenly spaced ones. `kind`: the class
    of a model of somebody's own, as of `load_model`.

    Raises `PalpateError` when the file is missing, no posterior, or of a model that has no name in
    files, `DamagedFileError` when something of the model is missing or does not fit.
    """
    if count is not None and count < 1:
        raise PalpateError(f"at least one draw is needed, not {count}")
    arrays, about = read_posterior(path)
    kind = kind_of(path, about.get("model"), about.get("sha256"), kind)
    fields = {name[6:]: value for name, value in arrays.items() if name.startswith("model.")}
    values = {name[6:]: value for name, value in arrays.items() if name.startswith("value.")}
    lead = arrays["position"].shape[:2] if "position" in arrays else ()
    settings = about.get("settings")
    if not isinstance(settings, dict) or any(v.shape[:2] != lead for v in values.values()):
        raise DamagedFileError(f"{path} is damaged: its draws are not of one length")
    chosen = spread_out(int(np.prod(lead)), count)
    drawn = {name: v.reshape(-1, *v.shape[2:])[chosen] for name, v in values.items()}
    settings = {name: tuple(v) if isinstance(v, list) else v for name, v in settings.items()}
    try:
        return build(path, kind, fields | drawn, settings)
    except PalpateError as error:
        raise DamagedFileError(str(error)) from error


def to_arviz(posterior: Posterior) -> Any:
    """ArviZ's `InferenceData`: parameters in their units, densities, and predictions of the probes.

    Predictions stand among the posterior's variables as `probe_end`, so that ArviZ's diagnostics
    judge them too. Raises `PalpateError` when ArviZ is not installed.
    """
    try:
        import arviz
    except ImportError as error:
        raise PalpateError(
            "exporting to ArviZ needs the extra 'bayes': pip install 'palpate[bayes]'"
        ) from error
    variables = {path.replace(".", "_"): value for path, value in posterior.values.items()}
    return arviz.from_dict(
        posterior={**variables, "probe_end": posterior.predictions},
        sample_stats={"lp": posterior.draws.density},
    )


def write_netcdf(path: str | Path, posterior: Posterior) -> Path:
    """Write `to_arviz` as NetCDF, which ArviZ and xarray read; raises `PalpateError` likewise."""
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        to_arviz(posterior).to_netcdf(str(part))
        part.replace(path)
    except OSError as error:
        raise PalpateError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return path
