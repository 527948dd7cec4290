"""`palpate record`: a simulated object is handled, and what its sensors show is kept."""

import dataclasses
from pathlib import Path
from typing import Any

from palpate.commands import folders
from palpate.errors import PalpateError
from palpate.families.options import Record
from palpate.recordings.files import read_recording, write_recording
from palpate.runs.result import read_result
from palpate.runs.run import RESULT


def run(options: Record) -> Path:
    """Record, say where the file is, and return its path.

    Raises `PalpateError` for no trials, and rather than overwrite another recording.
    """
    if options.trials < 1:
        raise PalpateError(f"a recording has at least one trial, not {options.trials}")
    configuration = {
        name: " ".join(value) if isinstance(value, tuple) else value  # provenance is text
        for name, value in folders.configuration_of(options, f"record {options.family}").items()
    }
    if options.out is not None and _is_there(options.out, options, configuration):
        print(f"recording: {options.out} (it was there already)")
        return options.out
    name = f"record-{options.family}"
    with folders.open_run(options, name, configuration, folders.RECORDING) as run:
        if not run.finished:
            recording = options.record()
            provenance = {**recording.provenance, **configuration}
            recording = dataclasses.replace(recording, provenance=provenance)
            write_recording(run.path / folders.RECORDING, recording)
            names = {"trial_names": [trial.name for trial in recording.trials]}
            folders.finish(run, settings=names)  # nothing is claimed
        count = len(read_result(run.path / RESULT).settings["trial_names"])
        path = folders.deliver(options, run, folders.RECORDING)
    trials = "1 trial" if count == 1 else f"{count} trials"
    print(f"recording: {path} ({trials} of {options.duration_in_words})")
    return path


def _is_there(file: Path, options: Record, configuration: dict[str, Any]) -> bool:
    """Whether the file holds this very recording: one may be dear, none is overwritten."""
    if options.fresh or not file.is_file() or file.suffix != Path(folders.RECORDING).suffix:
        return False
    provenance = read_recording(file).provenance
    if all(provenance.get(name) == value for name, value in configuration.items()):
        return True
    raise PalpateError(
        f"{file} holds another recording: give another --out, or --fresh to overwrite it"
    )
