"""What decides: the contract of every controller, and the files that controllers are kept in.

A file says of which kind its controller is. The kinds are `CommandPolicy`, `ActorPolicy`,
`GuardedPolicy` and what the families' table names as `controllers`: networks, planners,
hand-written laws.
"""

import dataclasses
import re
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, Key

from palpate.errors import PalpateError
from palpate.family import check_name, name_of, places, resolve
from palpate.networks.channels import Channel, channels_of
from palpate.runs.storage import load_arrays, read_json, read_manifest, save_arrays, write_json

_FORMAT, _VERSION = "palpate.controller", 1  # of JSON files
_NETWORK = "command network"
_OWN_KINDS = {
    _NETWORK: "palpate.networks.policy:CommandPolicy",
    "actor": "palpate.networks.guarded:ActorPolicy",
    "guarded actor": "palpate.networks.guarded:GuardedPolicy",
}
_DECLARED = ("observations", "actions", "period")


@runtime_checkable
class Controller(Protocol):
    """Who decides: `(carry, observation, goal, key) -> (carry, action)`, with or without a batch.

    A function of what is carried and seen, so that the same object runs inside a differentiated
    rollout, over a batch, and in a robot's control loop. `observation` is (*batch, features) as the
    task that the controller is made for gives it; in a trial it is what the worlds hand out, and
    what makes features of that stands in front of the controller and is carried with it. `goal` is
    what the task asks for (None where nothing varies) and `key` randomness, for controllers that
    use any (None otherwise). A batch is one leading axis of everything.

    `period`: seconds from one decision to the next that it was made for; None: any.
    """

    @property
    def period(self) -> float | None:
        """Seconds from one decision to the next; None: any."""
        ...

    def initial_carry(self, command: Any) -> Any:
        """What to carry into the first call.

        `command`, (*batch, *action_shape), is the action in force until then: zero at rest.
        """
        ...

    def __call__(
        self, carry: Any, observation: Any, goal: Any, key: Key[Array, "*batch"] | None
    ) -> tuple[Any, Any]:
        """The next carry, and the action to hold for one control period."""
        ...


class DeclaredController(eqx.Module):
    """A `Controller` that declares its channels, and so can be saved, loaded by kind and served.

    An observation is that of all `observations`, flat, one after the other. An action has the
    shape of its channel or, where `actions` are several, is all of them, flat, one after the
    other. `period` is in s from one decision to the next.
    """

    observations: eqx.AbstractVar[tuple[Channel, ...]]
    actions: eqx.AbstractVar[tuple[Channel, ...]]
    period: eqx.AbstractVar[float]

    @abstractmethod
    def initial_carry(self, command: Array) -> Any:
        """See `Controller`."""

    @abstractmethod
    def __call__(
        self, carry: Any, observation: Array, goal: Any, key: Key[Array, "*batch"] | None
    ) -> tuple[Any, Array]:
        """See `Controller`."""

    def settings(self, folder: Path) -> dict[str, Any]:
        """What `from_settings` needs besides the declaration and arrays: here all other fields.

        A file that belongs to it, such as a planner's model, is written into `folder` and named
        in the settings. Arrays stand in the safetensors file.
        """
        names = [field.name for field in dataclasses.fields(self)]
        return {name: getattr(self, name) for name in names if name not in _DECLARED}

    @classmethod
    def from_settings(cls, folder: Path, **settings: Any) -> "DeclaredController":
        """The controller of these settings, `observations`, `actions` and `period` among them.

        Arrays may have any values: they are read afterwards.
        """
        return cls(**settings)


def save_controller(
    path: str | Path, controller: DeclaredController, manifest: Mapping[str, Any]
) -> None:
    """Write a controller: as JSON if `path` ends so, else as safetensors with its arrays.

    What it is (kind, channels with units and limits, period, settings) joins the manifest as
    "controller"; `manifest` says what else a user must know: the task, what it was trained on.

    Raises `PalpateError` for a kind that no family's table names, and for JSON with arrays.
    """
    path, known = Path(path), _OWN_KINDS | places("controllers")
    kind = name_of(type(controller), known)
    if kind is None:
        raise PalpateError(
            f"a controller of type {type(controller).__name__} cannot be saved; kinds: "
            + ", ".join(known)
        )
    described = {
        "kind": kind,
        "observations": controller.observations,
        "actions": controller.actions,
        "period": controller.period,
        "settings": controller.settings(path.parent),
    }
    whole = {**manifest, "controller": described}
    if path.suffix != ".json":
        save_arrays(path, controller, whole)
        return
    if any(map(eqx.is_array, jax.tree.leaves(controller))):
        raise PalpateError(f"{path} cannot hold arrays: expected a name that ends in .safetensors")
    write_json(path, {"format": _FORMAT, "version": _VERSION, "manifest": whole})


def load_controller(path: str | Path) -> tuple[DeclaredController, dict[str, Any]]:
    """The controller that `save_controller` wrote, and its manifest.

    Raises `PalpateError` when the file holds something else or a kind that no family brings,
    `DamagedFileError` when it is damaged.
    """
    path = Path(path)
    in_json = path.suffix == ".json"
    manifest = _manifest(path, read_json(path)) if in_json else read_manifest(path)
    described = manifest.get("controller") or _earlier_description(manifest)
    if not isinstance(described, dict):
        raise PalpateError(
            f"{path} holds no controller: expected a file written by `palpate train` or "
            "`save_controller`"
        )
    known = _OWN_KINDS | places("controllers")
    kind = resolve(known[check_name("kind of controller", str(described.get("kind")), known)])
    try:
        declared = {
            "observations": channels_of(described["observations"]),
            "actions": channels_of(described["actions"]),
            "period": float(described["period"]),
        }
        settings = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in described["settings"].items()
        }
        made = lambda: kind.from_settings(path.parent, **declared, **settings)  # noqa: E731
        controller = made() if in_json else eqx.filter_eval_shape(made)
    except (KeyError, TypeError, AttributeError) as error:
        raise PalpateError(f"{path} does not say which controller it holds: {error}") from error
    return (controller, manifest) if in_json else load_arrays(path, controller)


def _manifest(path: Path, content: Any) -> dict[str, Any]:
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise PalpateError(f"{path} holds no controller: expected what `save_controller` wrote")
    if content.get("version") != _VERSION:
        raise PalpateError(
            f"{path} has version {content.get('version')}; this palpate reads version {_VERSION}"
        )
    return dict(content.get("manifest") or {})


def _earlier_description(manifest: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a file says of which the only kind was "command policy"; None if it is no such file.

    Its channels stood as sentences: features "(10, 3) m" by name, the action as "velocity, m/s".
    """
    policy = manifest.get("policy")
    if not isinstance(policy, dict) or policy.get("kind") != "command policy":
        return None
    seen = []
    for name, sentence in dict(manifest.get("features") or {}).items():
        match = re.fullmatch(r"\(([\d, ]+)\) ?(.*)", str(sentence))
        if match is None:
            raise PalpateError(
                f"the policy's feature '{name}' is described as '{sentence}': expected a shape "
                "and a unit, such as '(10, 3) m'"
            )
        sizes = [int(size) for size in match[1].replace(",", " ").split()]
        seen.append({"name": name, "shape": sizes, "unit": match[2]})
    name, _, unit = str(manifest.get("action", "action, ")).rpartition(", ")
    return {
        "kind": _NETWORK,
        "observations": seen or [{"name": "features", "shape": [policy.get("features")]}],
        "actions": [
            {"name": name, "shape": policy.get("action_shape"), "unit": unit}
            | {key: policy.get(key) for key in ("limit", "rate_limit")}
        ],
        "period": policy.get("period"),
        "settings": {key: policy.get(key) for key in ("width", "depth")},
    }
