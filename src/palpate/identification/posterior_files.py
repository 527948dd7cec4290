"""A posterior on disk: our own NPZ with JSON, and ArviZ's NetCDF for whoever works with that."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.bayesian import Posterior
from palpate.storage import DamagedFileError, parse_json, plain, write_bytes

FORMAT = "palpate-posterior-1"
_ABOUT = "about"  # the entry that holds JSON as text


def write_posterior(path: str | Path, posterior: Posterior) -> Path:
    """Write draws in whitened coordinates and in units, with what they are, as one NPZ file.

    Arrays: `position` (chains, draws, free), `density` (chains, draws), and `value.PATH` (chains,
    draws, ...) for each free parameter. `about`: JSON with names, the table, warnings and cost.
    """
    draws = posterior.draws
    arrays: dict[str, np.ndarray] = {"position": draws.position, "density": draws.density}
    arrays |= {f"value.{path}": value for path, value in posterior.values.items()}
    about = {
        "format": FORMAT,
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
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DamagedFileError(f"{path} is damaged or no NPZ file ({error})") from error
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise PalpateError(f"{path} is no posterior of the format {FORMAT}")
    return arrays, about


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
