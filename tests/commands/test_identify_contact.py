"""`palpate record contact` and `palpate identify contact`, the whole way on a short recording."""

import numpy as np

from palpate.cli import main
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.worlds.contact.plates import PlatesWorld

SEED = 4


def test_stiffness_and_friction_are_found_from_a_few_seconds(tmp_path):
    file, out = tmp_path / "R.npz", tmp_path / "out"
    asked = ["--seed", str(SEED), "--trials", "3", "--duration", "2"]
    main(["record", "contact", *asked, "--out", str(file)])
    method = ["--method", "levenberg-marquardt", "--iterations", "2", "2", "6"]
    main(["identify", "contact", str(file), *method, "--out", str(out)])
    result = read_result(out / RESULT)
    rows = {row["name"]: row for row in result.parameters}
    world = PlatesWorld()
    world.reset(SEED)
    plates = world.truth().plates
    np.testing.assert_allclose(rows["stiffness"]["value"], plates.stiffness, rtol=0.1)
    np.testing.assert_allclose(rows["friction"]["value"], plates.friction, rtol=0.1)
    assert rows["stiffness"]["unit"] == "N/m"
    units = {figure.unit for figure in result.figures}
    assert {"cm", "N"} <= units
