"""Paths: they start softly, keep their bounds, and files that are none are refused in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.tasks.rope.paths import (
    CURVES,
    FARTHEST,
    FASTEST,
    RISE,
    SHARPEST,
    DesiredPath,
    named_path,
    random_paths,
    read_path,
    soft_time,
)

PERIOD = 0.01


def derivatives(path):
    """Path, velocity, acceleration and jerk by differences."""
    found = [np.asarray(path, float)]
    for _ in range(3):
        found.append(np.diff(found[-1], axis=0) / PERIOD)
    return found


def test_time_rises_smoothly_to_its_own_pace() -> None:
    time = np.linspace(0, 3, 3001)
    soft = soft_time(time)
    rate = np.gradient(soft, time)
    assert soft[0] == 0
    assert (rate >= -1e-9).all()
    np.testing.assert_allclose(soft[time >= RISE], time[time >= RISE] - RISE / 2, atol=1e-9)
    # The rate itself is C2: neither it nor its two derivatives jump.
    for order, most in ((1, 0.01), (2, 0.02), (3, 0.15)):
        values = rate[5:-5]
        for _ in range(order - 1):
            values = np.gradient(values, 1e-3)
        assert np.abs(np.diff(values)).max() < most, order


@pytest.mark.parametrize("name", CURVES)
def test_named_paths_start_from_rest_and_are_as_long_as_asked(name) -> None:
    path = named_path(name, size=0.5, duration=5.0, period=PERIOD)
    assert path.shape == (501, 3)
    position, velocity, acceleration, jerk = derivatives(path)
    np.testing.assert_array_equal(position[0], 0)
    assert np.linalg.norm(velocity[0]) < 1e-4
    assert np.linalg.norm(acceleration[0]) < 0.01
    assert np.linalg.norm(jerk, axis=1).max() < 60  # m/s^3: no jump of the acceleration
    assert np.ptp(path[:, 0]) == pytest.approx(0.5, abs=2e-3)
    np.testing.assert_array_equal(path[:, 2], 0)


@pytest.mark.parametrize("name", ["lemniscate", "egg"])
def test_closed_paths_close_and_go_on(name) -> None:
    path = named_path(name, size=0.4, duration=4.0, period=PERIOD, beyond=0.5)
    assert len(path) == 451
    np.testing.assert_allclose(path[400], 0, atol=1e-6)
    assert np.linalg.norm(np.diff(path[400:], axis=0), axis=1).min() > 1e-4


def test_planes_tilt_and_turn() -> None:
    plain = named_path("egg", size=0.4, duration=4.0, period=PERIOD)
    moved = named_path("egg", size=0.4, duration=4.0, period=PERIOD, azimuth=0.7, tilt=0.5)
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1) for path in (plain, moved)]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=1e-9)
    np.testing.assert_allclose(moved[:, 2], plain[:, 1] * np.sin(0.5), atol=1e-9)


def test_what_does_not_exist_is_named() -> None:
    with pytest.raises(PalpateError, match=r"unknown path 'circle'; there are: lemniscate, egg"):
        named_path("circle", size=0.4, duration=4.0, period=PERIOD)
    with pytest.raises(PalpateError, match=r"takes longer than 1 s, not 0\.5 s"):
        named_path("egg", size=0.4, duration=0.5, period=PERIOD)


def test_a_file_is_followed_through_its_points(tmp_path) -> None:
    time = np.linspace(2.0, 5.0, 31)
    truth = np.stack([0.1 * time, 0.1 * np.sin(2 * time), 1 + 0 * time], axis=1)
    rows = "\n".join(f"{t}, {x}, {y}, {z}, a" for t, (x, y, z) in zip(time, truth, strict=True))
    (tmp_path / "path.csv").write_text("time, x, y, z, what\n" + rows)
    path = read_path(tmp_path / "path.csv", PERIOD, beyond=0.3)
    assert len(path) == 351 + 30
    np.testing.assert_array_equal(path[350:], np.broadcast_to(path[-1], (31, 3)))
    np.testing.assert_allclose(path[-1], truth[-1] - truth[0], atol=1e-9)
    inside = soft_time(np.arange(351) * PERIOD) + 2.0
    np.testing.assert_allclose(path[:351, 1], 0.1 * (np.sin(2 * inside) - np.sin(4)), atol=2e-3)
    assert np.linalg.norm(path[1]) < 1e-6  # from rest, although the file is not


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("time,x,y\n0,0,0", "no column z: expected a header with time, x, y, z"),
        ("", "no column time, x, y, z"),
        ("time,x,y,z\n0,0,0,0\n1,0,nan,0", "line 3: expected finite numbers for time, x, y, z"),
        ("time,x,y,z\n0,0,0,0\n1,0", "line 3: expected finite numbers for time, x, y, z"),
        (
            "time,x,y,z\n0,0,0,0\n0,1,0,0",
            "line 3: the time 0 does not come after 0; sort the rows by time",
        ),
        ("time,x,y,z\n0,0,0,0", "has 1 points: a path needs at least two"),
    ],
)
def test_files_that_are_no_path_are_refused(text, sentence, tmp_path) -> None:
    (tmp_path / "path.csv").write_text(text)
    with pytest.raises(PalpateError, match=sentence):
        read_path(tmp_path / "path.csv", PERIOD)


def test_files_that_cannot_be_read_are_refused(tmp_path) -> None:
    with pytest.raises(PalpateError, match=r"cannot read .*nothing"):
        read_path(tmp_path / "nothing.csv", PERIOD)
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(PalpateError, match="not a CSV file in UTF-8"):
        read_path(tmp_path / "bytes.csv", PERIOD)


def test_random_paths_are_soft_bounded_and_varied() -> None:
    paths = np.asarray(random_paths(jax.random.key(0), 64, 500, PERIOD), float)
    assert paths.shape == (64, 500, 3)
    np.testing.assert_array_equal(paths[:, 0], 0)
    speed = np.linalg.norm(np.diff(paths, axis=1), axis=-1) / PERIOD
    sharp = np.linalg.norm(np.diff(paths, 2, axis=1), axis=-1) / PERIOD**2
    assert speed[:, 0].max() < 1e-3
    assert speed.max() <= FASTEST * 1.001
    assert sharp.max() <= SHARPEST * 1.1  # float32, twice differenced
    far = np.linalg.norm(paths, axis=-1).max(1)
    assert far.max() <= FARTHEST * 1.001
    assert far.std() > 0.1
    assert np.ptp(paths[..., 2], axis=1).max() > 0.1
    assert len({tuple(path[-1]) for path in paths}) == 64


def test_a_path_looked_at_ahead_ends_where_it_ends() -> None:
    path = DesiredPath(jnp.arange(12.0).reshape(4, 3), PERIOD)
    ahead = path.ahead(jnp.array([0, 1, 9]), 1)
    np.testing.assert_array_equal(ahead[:, 0], [3, 6, 9])
