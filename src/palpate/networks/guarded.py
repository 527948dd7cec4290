"""Actors as controllers, alone or under a guard that knows what is risky."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from palpate.errors import PalpateError
from palpate.networks.actor import Critic, DeterministicActor, GaussianActor
from palpate.networks.channels import Channel, count_of
from palpate.networks.controller import DeclaredController, load_controller

ACTORS = {"gaussian": GaussianActor, "deterministic": DeterministicActor}


class Guard(eqx.Module):
    """A critic of risks, and the actor that takes over where it warns (arXiv 2010.15920).

    Both see the numbers `seen` of an observation, all where it is None. The risk, in [0, 1], is the
    greater of two discounted probabilities of a violation; where it is not finite it is 1.
    """

    critic: Critic
    recovery: DeterministicActor
    seen: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def part(self, observation: Float[Array, "*batch features"]) -> Array:
        """What of an observation it sees."""
        return observation if self.seen is None else observation[..., jnp.array(self.seen)]

    def risk(
        self, observation: Float[Array, "*batch features"], action: Float[Array, "*batch actions"]
    ) -> Float[Array, "*batch"]:
        """Of the action in that situation."""
        risk = jnp.max(jax.nn.sigmoid(self.critic(self.part(observation), action)), axis=0)
        return jnp.where(jnp.isfinite(risk), risk, 1.0)

    def recover(self, observation: Float[Array, "*batch features"]) -> Array:
        """The action (*batch, actions) that makes the risk least."""
        return self.recovery.mean(self.part(observation))

    def overrule(
        self,
        observation: Float[Array, "*batch features"],
        proposed: Float[Array, "*batch actions"],
        threshold: float,
    ) -> Float[Array, "*batch actions"]:
        """The proposed action, or the recovery's where its risk is above the threshold."""
        risky = self.risk(observation, proposed) > threshold
        return jnp.where(risky[..., None], self.recover(observation), proposed)


def still(action: Float[Array, "*batch actions"]) -> Float[Array, "*batch actions"]:
    """The action, or zeros where any of its numbers is not finite."""
    return jnp.where(jnp.all(jnp.isfinite(action), axis=-1, keepdims=True), action, 0.0)


class ActorPolicy(DeclaredController):
    """What an actor does at its best: actions in [-1, 1], for each channel in its shape and order.

    Without a memory. An action that is not finite, as after a sensor has dropped out, is zero.
    """

    actor: GaussianActor | DeterministicActor
    observations: tuple[Channel, ...] = eqx.field(static=True)
    actions: tuple[Channel, ...] = eqx.field(static=True)
    period: float = eqx.field(static=True)

    def initial_carry(self, command: Any) -> None:
        """Nothing; see `Controller.initial_carry`."""

    def propose(self, observation: Float[Array, "*batch features"]) -> Array:
        """The actor's action (*batch, actions)."""
        return self.actor.mean(observation)

    def __call__(
        self,
        carry: Any,
        observation: Float[Array, "*batch features"],
        goal: Any = None,
        key: Key[Array, "*batch"] | None = None,
    ) -> tuple[Any, Array]:
        """Nothing to carry, and the action: (*batch, *shape) of one channel, else flat."""
        action = still(self.execute(observation))
        shape = self.actions[0].shape if len(self.actions) == 1 else action.shape[-1:]
        return carry, action.reshape(*action.shape[:-1], *shape)

    def execute(self, observation: Float[Array, "*batch features"]) -> Array:
        """What is done of what is proposed, (*batch, actions): here all of it."""
        return self.propose(observation)

    def settings(self, folder: Path) -> dict[str, Any]:
        """See `DeclaredController.settings`: what kind of actor, and its layers."""
        kind = next(name for name, one in ACTORS.items() if isinstance(self.actor, one))
        return {"actor": kind, "layers": self.actor.network.sizes[1:-1]}

    @classmethod
    def from_settings(cls, folder: Path, **settings: Any) -> "ActorPolicy":
        kind, (width, *others) = ACTORS[settings.pop("actor")], settings.pop("layers")
        seen, done = count_of(settings["observations"]), count_of(settings["actions"])
        actor = kind.create(jax.random.key(0), seen, done, width, 1 + len(others))
        return cls(actor=actor, **settings)


class GuardedPolicy(ActorPolicy):
    """An actor under a guard: where its action is riskier than `threshold`, the recovery acts.

    Fails closed: a risk that is not finite counts as 1, an action that is not finite as zero.
    """

    guard: Guard
    threshold: float = eqx.field(static=True)

    def risk(
        self, observation: Float[Array, "*batch features"], action: Float[Array, "*batch actions"]
    ) -> Float[Array, "*batch"]:
        """The guard's, of a flat action in [-1, 1]; see `Guard.risk`."""
        return self.guard.risk(observation, action)

    def execute(self, observation: Float[Array, "*batch features"]) -> Array:
        """The proposed action (*batch, actions), or the recovery's where it is risky."""
        return self.guard.overrule(observation, self.propose(observation), self.threshold)

    def settings(self, folder: Path) -> dict[str, Any]:
        """See `DeclaredController.settings`: those of the actor, and of the guard."""
        guard = {"threshold": self.threshold, "seen": self.guard.seen}
        layers = self.guard.critic.network.sizes[1:-1]
        return super().settings(folder) | guard | {"guard_layers": layers}

    @classmethod
    def from_settings(cls, folder: Path, **settings: Any) -> "GuardedPolicy":
        seen, layers = settings.pop("seen"), settings.pop("guard_layers")
        threshold = settings.pop("threshold")
        alone = ActorPolicy.from_settings(folder, **settings)
        features = count_of(alone.observations) if seen is None else len(seen)
        guard = untrained_guard(jax.random.key(0), features, count_of(alone.actions), layers, seen)
        declared = {name: getattr(alone, name) for name in ("observations", "actions", "period")}
        return cls(actor=alone.actor, guard=guard, threshold=threshold, **declared)


def load_actor(path: str | Path) -> tuple[ActorPolicy, dict[str, Any]]:
    """The actor that `save_controller` wrote, guarded or not, and its manifest.

    Raises `PalpateError` for a controller of another kind, and as `load_controller`.
    """
    policy, manifest = load_controller(path)
    if not isinstance(policy, ActorPolicy):
        raise PalpateError(
            f"{path} holds a {type(policy).__name__}: expected an actor that learnt in a world"
        )
    return policy, manifest


def untrained_guard(
    key: Array, features: int, actions: int, layers: Sequence[int], seen: tuple[int, ...] | None
) -> Guard:
    """A guard that sees so many numbers; its layers are all as wide as the first."""
    keys, shape = jax.random.split(key), (features, actions, layers[0], len(layers))
    critic = Critic.create(keys[0], *shape)
    return Guard(critic, DeterministicActor.create(keys[1], *shape), seen)
