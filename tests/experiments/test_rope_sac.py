"""SAC on a small rope. Needs the extra `sac`, which `make test` does not install."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from palpate.experiments.rivals.rope_environment import Actor  # noqa: E402
from palpate.experiments.rivals.soft_actor_critic import Sac, as_actor, trained_actor  # noqa: E402
from palpate.learning import Training  # noqa: E402
from palpate.models.rope import Rope  # noqa: E402
from palpate.runs.storage import read_manifest  # noqa: E402
from small_rope import VELOCITY  # noqa: E402


def small_model() -> Rope:
    return Rope.uniform(1.0, 0.1, 4, drive="velocity", substeps=4, bend_stiffness=1e-4)


def test_the_actor_is_the_librarys() -> None:
    """ReLU units, a linear mean, tanh: as its deterministic actions are computed."""
    from gymnasium.spaces import Box
    from stable_baselines3.common.torch_layers import FlattenExtractor  # pyright: ignore
    from stable_baselines3.sac.policies import Actor as Theirs  # pyright: ignore

    seen = Box(-np.inf, np.inf, (21,), np.float32)
    theirs = Theirs(seen, Box(-1, 1, (3,)), [8, 8], FlattenExtractor(seen), 21)
    examples = jax.random.normal(jax.random.key(0), (50, 18))
    untrained = Actor.untrained(
        jax.random.key(1), examples, actions=VELOCITY, period=0.01, width=8, depth=2,
    )  # fmt: skip
    ours = as_actor(untrained, theirs.state_dict())
    told = np.array(ours.inputs(jnp.full((50, 1, 3), 0.3), examples))
    with torch.no_grad():
        expected = theirs(torch.as_tensor(told), deterministic=True).numpy()
    np.testing.assert_allclose(jax.vmap(ours.network)(told), expected, atol=1e-6)


def test_training_is_kept_and_read_again(tmp_path) -> None:
    training = Training(starts=64, width=8)
    sac = Sac(rounds=2, environments=2, updates=1)
    actor, about = trained_actor(tmp_path, small_model(), training, sac, seed=3)
    assert about["environment_steps"] == 2 * 2 * 200
    assert about["updates"] == 2 * 200 - 50  # the first hundred transitions are only collected
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2]
    again, _ = trained_actor(tmp_path, small_model(), training, sac, seed=3)
    for kept, read in zip(jax.tree.leaves(actor), jax.tree.leaves(again), strict=True):
        if hasattr(kept, "shape"):
            np.testing.assert_array_equal(kept, read)
    assert read_manifest(tmp_path / "actor.safetensors")["algorithm"] == "SAC"
