"""What furniture may be, as models to be compared: on wheels, on feet, hinged, bolted, joined.

Several bodies are taken one by one first, as if nothing but the measured wrench moved them. Which
of them are joined is then a question about the whole: a pivot is a candidate where one point of
the one body stays at one point of the other, and evidence decides.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from palpate.families.furniture.recording import (
    POSE,
    WRENCH,
    names_of,
    one_body,
    prune_contacts,
    starting_furniture,
)
from palpate.families.options import Hypotheses
from palpate.identification.posterior.comparison import explore, posterior_of, shares
from palpate.models.model import Model
from palpate.models.planar import Planar
from palpate.models.planar.planar import wrap_angle
from palpate.numerics.arrays import as_array
from palpate.parameters import declare, parameters_of, value_of, with_values
from palpate.recordings import Recording
from palpate.runs.progress import progress

Law = Literal["coulomb", "viscous"]
Pair = tuple[int, int]

SLACK = 0.02  # m by which the two points of a joint may part (root mean square)
MOVED = 0.05  # m or rad: who moves less tells nothing of joints
JOINTS = 3  # candidates at most, the tightest: every set of them is a hypothesis


class Held(NamedTuple):
    """A pivot: a point of a body, where that is held, both (2,) in m, and the body's angle there.

    Place and angle (rad) are in the axes of what holds it: the world, or another body.
    """

    own: np.ndarray
    place: np.ndarray
    angle: float


def structures(
    recording: Recording,
    period: float,
    size: tuple[float, float] | None = None,
    wheels: int = 1,
    law: Law = "coulomb",
) -> dict[str, Planar]:
    """What each body may be, as models: on wheels, on feet, hinged, or bolted down.

    What is on feet or on a hinge has no wheels that resist; free casters are small friction of the
    floor. All but the hinged one have one shape, and are compiled once; a link, with which bodies
    are stepped in three times the time, has the hinged one alone, and nothing that it does not
    need. Arguments as of `starting_furniture` and `furniture`.
    """
    bodies = range(len(names_of(recording)))
    free = starting_furniture(recording, period, size, wheels=wheels, law=law)
    free = _with_bolts(free, recording)
    held = starting_furniture(recording, period, size, wheels=0, pivots=dict.fromkeys(bodies))
    held = declare(held, link_other_anchor={"fixed": True})  # a pivot's follows from its own
    held = _with_pivots(held, {body: _hinge(recording, body) for body in bodies})
    return {
        name: _mask(held if name == "hinge" else free, dict.fromkeys(bodies, name))
        for name in ("wheels", "feet", "hinge", "bolted")
    }


def hypotheses(
    recording: Recording,
    period: float,
    size: tuple[float, float] | None = None,
    wheels: int = 1,
    law: Law = "coulomb",
    seed: int = 0,
    declared: Callable[[Model], Model] = lambda model: model,
) -> Hypotheses:
    """What the bodies of a recording may be together, by a name that says it.

    Of one body, its `structures`. Of several, each is what it most probably is by itself, and any
    of the `joints` may be there: what is joined is taken to be on wheels, as nobody knows what its
    wheels did before the joint is known. Arguments as of `structures`; `declared` gives a model of
    one body what is known of its parameters.
    """
    names = names_of(recording)
    if len(names) == 1:
        return Hypotheses(structures(recording, period, size, wheels, law))
    kinds, pieces, by_itself = {}, [], {}
    for body, name in progress(list(enumerate(names)), "each body by itself"):
        piece = one_body(recording, body)
        aligned = piece.align(period, POSE, WRENCH)
        models = structures(piece, period, size, wheels, law)
        found = explore(
            {
                kind: posterior_of(declared(prune_contacts(model, piece)), aligned)
                for kind, model in models.items()
            },
            seed,
        )
        probability = shares({kind: settled.evidence for kind, settled in found.items()})
        kinds[body] = max(probability, key=probability.__getitem__)
        pieces.append({kind: settled.model for kind, settled in found.items()})
        by_itself[name] = probability
    likely = joints(recording)
    models = {}
    sets = (itertools.combinations(likely, count) for count in range(len(likely) + 1))
    for chosen in itertools.chain.from_iterable(sets):
        joined = {body for pair in chosen for body in pair}
        together = {b: "wheels" if b in joined else kind for b, kind in kinds.items()}
        where = {pair: likely[pair] for pair in chosen}
        model = _together(recording, period, size, wheels, law, together, where)
        begun = [pieces[body][kind] for body, kind in together.items()]
        models[_name_of(names, together, chosen)] = _begun(model, begun)
    return Hypotheses(models, by_itself)


def joints(recording: Recording) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
    """Pairs of bodies that a pivot may join, the tightest first, and where.

    By pair (i, j), i < j, the point of each body (2,), m in its frame, that stays at that of the
    other in all frames in which both are seen: least squares over R_i a_i + p_i = R_j a_j + p_j.
    Pairs that part by more than `SLACK`, or of which one hardly moves, are left out.
    """
    trials = [dataclasses.replace(recording, trials=(trial,)) for trial in recording.trials]
    found = {}
    for pair in itertools.combinations(range(len(names_of(recording))), 2):
        of = [seen for trial in trials if len(seen := _poses_of(trial, pair))]
        if not of or not all(
            max(np.ptp(seen[:, body], axis=0).max() for seen in of) > MOVED for body in range(2)
        ):
            continue
        place, parting = _common_point(np.concatenate(of))
        if parting <= SLACK:
            found[pair] = parting, place
    tightest = sorted(found, key=lambda pair: found[pair][0])[:JOINTS]
    return {pair: found[pair][1] for pair in tightest}


def _common_point(
    poses: Float[np.ndarray, "frames 2 3"],
) -> tuple[tuple[np.ndarray, np.ndarray], float]:
    """The points of two bodies that stay closest together, and how far they part, m."""
    cosine, sine = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    turn = np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
    design = np.concatenate([turn[:, 0], -turn[:, 1]], axis=2).reshape(-1, 4)
    between = (poses[:, 1, :2] - poses[:, 0, :2]).reshape(-1)
    # The shortest where the turn between them never changes: any point would do.
    anchors, *_ = np.linalg.lstsq(design, between, rcond=1e-3)
    off = (design @ anchors - between).reshape(-1, 2)
    return (anchors[:2], anchors[2:]), float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def _together(
    recording: Recording,
    period: float,
    size: tuple[float, float] | None,
    wheels: int,
    law: Law,
    kinds: Mapping[int, str],
    chosen: Mapping[Pair, tuple[np.ndarray, np.ndarray]],
) -> Planar:
    """All bodies as one model, with the `chosen` joints."""
    pivots: dict[int, int | None] = {b: None for b, kind in kinds.items() if kind == "hinge"}
    # A body has one pivot of its own: as few joints as there are can be shared out so.
    owners = next(of for of in itertools.product(*chosen) if len(set(of)) == len(of))
    others = {owner: sum(pair) - owner for owner, pair in zip(owners, chosen, strict=True)}
    pivots |= others
    model = starting_furniture(recording, period, size, wheels=wheels, law=law, pivots=pivots)
    held = {b: _hinge(recording, b) for b, other in pivots.items() if other is None}
    for (owner, other), pair in zip(others.items(), chosen, strict=True):
        own, place = (chosen[pair][pair.index(body)] for body in (owner, other))
        # Where both were seen, not where each was seen first: the one may have moved before.
        first = _poses_of(recording, [owner, other])[0]
        held[owner] = Held(own, place, first[0, 2] - first[1, 2])
    return _mask(_with_bolts(_with_pivots(model, held), recording), kinds, set(others))


def _hinge(recording: Recording, body: int) -> Held:
    """The point of a body that moves least in the world, and where that is.

    Of all frames: a hinge that is where the noise of one pose puts it is off by as much at every
    moment, and evidence then prefers a wheel that hardly gives way.
    """
    seen = _poses_of(recording, [body])
    # Seen from where it was first: of what never turns the point is its centroid, wherever it is.
    first = np.array([*seen[0, 0, :2], 0.0])
    (own, place), _ = _common_point(np.concatenate([seen - first, np.zeros_like(seen)], axis=1))
    return Held(own, place + first[:2], seen[0, 0, 2])


def _poses_of(recording: Recording, bodies: Sequence[int]) -> Float[np.ndarray, "frames bodies 3"]:
    """Poses of these bodies in the frames that show all of them."""
    poses = np.concatenate([np.asarray(trial[POSE].values, float) for trial in recording.trials])
    poses = poses[:, bodies]
    return poses[np.isfinite(poses).all(axis=(1, 2))]


def _with_bolts(model: Planar, recording: Recording) -> Planar:
    """The model in which what may be bolted stands at the mean of all poses.

    One place for all that is predicted: were it where each piece of motion begins, it would have
    three freedoms in each, where a hinge has one, and evidence would call all that stands hinged.
    """
    standing = []
    for body in range(model.bodies):
        seen = _poses_of(recording, [body])[:, 0]
        off = seen - seen[0]
        off[:, 2] = wrap_angle(jnp.asarray(off[:, 2]))
        standing.append(seen[0] + off.mean(axis=0))
    return dataclasses.replace(model, bolted_pose=np.array(standing))


def _with_pivots(model: Planar, held: Mapping[int, Held]) -> Planar:
    """The model whose bodies' pivots are where they are `held`."""
    anchor, pose = np.array(model.link_anchor), np.array(model.link_pose)
    for body, (own, place, angle) in held.items():
        anchor[body, 0] = own / np.asarray(model.half_extent[body])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        pose[body, 0] = (*(place - turn @ own), angle)
    return dataclasses.replace(model, link_anchor=as_array(anchor), link_pose=as_array(pose))


def _begun(model: Planar, pieces: Sequence[Model]) -> Planar:
    """The model with the values that its bodies have by themselves, but for its joints."""
    values = {}
    for path in parameters_of(model):
        value = value_of(model, path)
        if not value.size or path.startswith("link_"):
            continue
        rows = [value_of(piece, path) for piece in pieces]  # a hinged one has no wheels
        rows = [own if own.size else value[body : body + 1] for body, own in enumerate(rows)]
        values[path] = jnp.concatenate(rows)
    anchor = model.link_anchor
    for body, piece in enumerate(pieces):
        own = value_of(piece, "link_anchor")  # none but of a hinged one, which is held by the world
        if own.size:
            anchor = anchor.at[body, : own.shape[1]].set(own[0])
    return with_values(model, values | {"link_anchor": anchor})


def _mask(model: Planar, kinds: Mapping[int, str], joined: Iterable[int] = ()) -> Planar:
    """The model with the wheels, hinges and bolts of what its bodies are, and their joints."""
    rows = range(len(kinds))
    rolls = jnp.asarray([[kinds[b] == "wheels"] for b in rows])
    held = jnp.asarray([[kinds[b] == "hinge" or b in joined] for b in rows])
    bolted = jnp.asarray([kinds[b] == "bolted" for b in rows])
    return dataclasses.replace(
        model,
        wheel=jnp.where(rolls, jnp.ones_like(model.wheel), 0.0),
        pivot=jnp.where(held, jnp.ones_like(model.pivot), 0.0),
        bolted=jnp.where(bolted, jnp.ones_like(model.bolted), 0.0),
    )


def _name_of(names: tuple[str, ...], kinds: Mapping[int, str], chosen: Iterable[Pair]) -> str:
    """Such as "cart: wheels, table: wheels, cart joined to table"."""
    parts = [f"{names[body]}: {kind}" for body, kind in kinds.items()]
    parts += [f"{names[first]} joined to {names[second]}" for first, second in chosen]
    return ", ".join(parts)
