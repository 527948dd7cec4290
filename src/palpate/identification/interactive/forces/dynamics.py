"""What a hand felt of a twin's parts: their masses, and what resists at their joints.

A hand that holds a part says where its joint is all the while, and the force that it gives is
known: joint positions are observed, and forces on links act. That is a recording which any
identification takes; a regression of it, at once, is where one starts.
"""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.interactive.description import describe
from palpate.identification.interactive.forces.action import (
    END,
    POSITION,
    SHORTEST,
    Action,
    axis_by_gravity,
    weight_at,
)
from palpate.identification.interactive.forces.resistance import Resistance, regress
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.articulated import Articulated
from palpate.models.articulated.assembly import assemble
from palpate.models.articulated.description import Description, Inertial
from palpate.models.articulated.links import FREE, Link, tree_of
from palpate.parameters import LogNormal, declare, with_values
from palpate.recordings import Recording

STOP = {"revolute": 0.02, "prismatic": 3e-3}  # rad, m that a stop may be beyond where it was felt
SUBSTEPS = 4
NO_SPRING = 1e-3  # N m/rad or N/m: of a joint without a spring, beside one with
SMALLEST = 0.1  # of a moment of inertia about the centre of mass
UNKNOWN = Resistance(
    1.0, 0.5, 2.0, 0.0, 0.0, (0.0, 0.0, 0.0), np.diag([1.0, 0.5, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
)


@dataclasses.dataclass(frozen=True, eq=False)
class Dynamics:
    """What a twin's actions say of its dynamics.

    `recording` has the channels `POSITION` (links,), NaN of what moved unseen, and `FORCE`
    (links, 7) as `Articulated` takes it. `model` is where an identification starts, `parts` the
    number of the part that each of its links is. `resistance` is of each link's joint, None where
    no hand has moved it; `inertia` (kg m^2 or kg, 0 where unknown) is what each joint moves.
    `latches` (N m or N) is what broke each loose beyond friction.
    """

    recording: Recording
    model: Articulated
    parts: list[int]
    resistance: list[Resistance | None]
    inertia: list[float]
    latches: list[float]

    @property
    def warnings(self) -> list[str]:
        """Sentences about what a tree of links does not have, or what nobody has felt."""
        said = []
        for part, own, latch in zip(self.parts, self.resistance, self.latches, strict=True):
            of = f"part {part + 1}"
            if own is None:
                said.append(
                    f"{of}: no hand has moved it alone: its mass and resistance are guesses"
                )
            if latch > 0.0:
                said.append(
                    f"{of}: a latch, or friction at rest, of {latch:.2g} N m or N beyond what it "
                    "has on its way; the model does not have it"
                )
            if own is not None and own.stiffness > 0.0:
                said.append(
                    f"{of}: a spring of {own.stiffness:.2g} N m/rad or N/m, at rest at "
                    f"{own.pull / own.stiffness:.2g} rad or m; a URDF does not have it"
                )
        return said

    def draws(self, count: int, seed: int) -> Articulated:
        """As many models as one with a batch axis, from what is known of each joint."""
        random = np.random.default_rng(seed)
        known = [
            own or UNKNOWN._replace(friction=float(friction))
            for own, friction in zip(self.resistance, self.model.friction, strict=True)
        ]
        drawn = np.array([own.draws(count, random) for own in known])
        shares, damping, friction, stiffness, pull, *offset = np.moveaxis(drawn, (2, 1), (0, 1))
        shares = shares / np.array([own.mass_share for own in known])
        sprung = np.array([own.stiffness > 0.0 for own in known])
        stiffness = np.where(sprung, np.maximum(stiffness, NO_SPRING), 0.0)
        rest = pull / np.where(sprung, stiffness, 1.0)
        moved = np.stack(offset, axis=-1) - np.array([own.offset for own in known])
        model = self.model
        slides = np.asarray(model.prismatic) > 0.0
        beyond = np.where(slides, STOP["prismatic"], STOP["revolute"]) * np.abs(
            random.standard_normal((2, *shares.shape))
        )
        return with_values(
            model,
            {
                name: jnp.asarray(value, model.mass.dtype)
                for name, value in {
                    "mass": np.asarray(model.mass) * shares,
                    "damping": damping,
                    "friction": friction,
                    "stiffness": stiffness,
                    "rest": rest,
                    "lower": np.asarray(model.lower) - beyond[0],
                    "upper": np.asarray(model.upper) + beyond[1],
                    **_centres(model, moved),
                }.items()
            },
        )

    def describe_with(
        self, description: Description, model: Articulated | None = None
    ) -> Description:
        """A twin's description with what was felt, or with what the `model` was identified as; but
        for springs, which a description does not have."""
        model = model or self.model
        links, joints = list(description.links), list(description.joints)
        place = {link.name: number for number, link in enumerate(links)}
        for link, (part, own) in enumerate(zip(self.parts, self.resistance, strict=True)):
            if own is None:
                continue  # nobody knows more than what was seen
            joint, lower, upper = joints[part], float(model.lower[link]), float(model.upper[link])
            joints[part] = dataclasses.replace(
                joint,
                damping=float(model.damping[link]),
                friction=float(model.friction[link]),
                lower=lower if lower > -FREE else joint.lower,
                upper=upper if upper < FREE else joint.upper,
            )
            number = place[joints[part].child]
            seen = links[number].inertial
            assert seen is not None  # of a description without faults
            mass, centre = float(model.mass[link]), np.asarray(model.centre_of_mass[link], float)
            shape = float(model.gyration[link]) ** 2 / seen.mass * seen.inertia
            inertial = Inertial(mass, centre, mass * shape)
            links[number] = dataclasses.replace(links[number], inertial=inertial)
        return dataclasses.replace(description, links=tuple(links), joints=tuple(joints))


def dynamics_of(twin: Twin) -> Dynamics:
    """From each action in which a hand moved a part, and nothing that carries it moved.

    What happens at the end of a joint, where a stop pushes, is left out; so is the reach of a latch
    that is found, but not of the regression, which would lose a part's first and best moments. A
    joint ends where a stop has held it against a hand or, if no hand felt it, against its weight.
    Raises `PalpateError` where no such action is left.
    """
    tree = assemble(describe(twin, "twin"))
    parts = [int(name.split()[-1]) - 1 for name in tree.joints]
    links = [
        dataclasses.replace(link, axis=axis_by_gravity(twin, part, np.asarray(link.axis)))
        for link, part in zip(tree.links, parts, strict=True)
    ]
    actions = [Action(twin, number) for number, (part, _) in enumerate(twin.held)
               if part >= 0 and twin.handled[number].moved]  # fmt: skip
    actions = [one for one in actions if one.alone]
    found = [_felt([one for one in actions if one.part == part], links, parts) for part in parts]
    weighed = [_weighed(link, one.resistance) for link, one in zip(links, found, strict=True)]
    found = [
        _unfelt(twin, part, weighed, parts) if one.resistance is None else one
        for part, one in zip(parts, found, strict=True)
    ]
    resistance = [one.resistance for one in found]
    links = [
        dataclasses.replace(link, lower=max(one.lower, -FREE), upper=min(one.upper, FREE))
        for link, one in zip(links, found, strict=True)
    ]
    trials = []
    for one in actions:
        known = resistance[parts.index(one.part)]
        span = one.span(known is not None and one.latch(known, links, parts) > 0.0)
        if span.stop - span.start >= SHORTEST:
            trials.append(one.trial(span, parts))
    if not trials:
        raise PalpateError(
            "no action moved a part by itself while the hand held it: nothing is known of forces; "
            "try more pushes"
        )
    period = float(f"{np.median(np.diff(trials[0][POSITION].time)):.5g}")
    recording = Recording(tuple(trials), {"source": "actions on an appliance"})
    model = _model(links, [one.resistance or one.guess for one in found], period)
    inertia, latches = [one.inertia for one in found], [one.latch for one in found]
    return Dynamics(recording, model, parts, resistance, inertia, latches)


class _Felt(NamedTuple):
    """What hands felt at one joint, see `Dynamics`, and where stops are: infinite where unknown."""

    resistance: Resistance | None = None
    inertia: float = 0.0
    latch: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    guess: Resistance = UNKNOWN


def _weighed(link: Link, known: Resistance | None) -> Link:
    """A link with the mass that was felt, and where that is."""
    if known is None:
        return link
    centre = np.asarray(link.centre_of_mass) + np.array(known.offset)
    return dataclasses.replace(link, mass=link.mass * known.mass_share, centre_of_mass=centre)


def _unfelt(twin: Twin, part: int, links: list[Link], parts: list[int]) -> _Felt:
    """Of a joint at which no hand felt anything: where the part was seen to rest, friction holds
    its weight, or a stop if that is an end of what was seen of its range."""
    one, held = twin.parts[part], [before + 1 for _, before in twin.held]
    (low, high), margin = one.range, END[one.screw.joint]
    rests = [
        (one.positions[look], weight_at(twin, part, look, links, parts))
        for look in range(len(twin.looks))
        if look not in held  # by a hand, that or another part
    ]
    upper = [place > high - margin and weight > 0.0 for place, weight in rests]
    lower = [place < low + margin and weight < 0.0 for place, weight in rests]
    free = [abs(weight) for (_, weight), *at_end in zip(rests, upper, lower, strict=True)
            if not any(at_end)]  # fmt: skip
    friction = max([UNKNOWN.friction, *free])
    stopped = [abs(weight) > friction for _, weight in rests]
    return _Felt(
        lower=low if np.any(np.logical_and(stopped, lower)) else -math.inf,
        upper=high if np.any(np.logical_and(stopped, upper)) else math.inf,
        guess=UNKNOWN._replace(friction=friction),
    )


def _felt(actions: list[Action], links: list[Link], parts: list[int]) -> _Felt:
    """What the actions on one part say; nothing where too little of it moved."""
    motions = [one.motion(links, parts) for one in actions]
    known = regress([one for one in motions if len(one.times) >= SHORTEST])
    if known is None:
        return _Felt()
    lower, upper = zip(*(one.stop(known, links, parts) for one in actions), strict=True)
    return _Felt(
        known,
        known.mass_share * motions[0].inertia,
        max(one.latch(known, links, parts) for one in actions),
        max(lower),
        min(upper),
    )


def _model(links: list[Link], known: list[Resistance], period: float) -> Articulated:
    """The tree with what is known of each joint, or guessed."""
    sprung = any(one.stiffness for one in known)
    started = [
        dataclasses.replace(
            link,
            mass=link.mass * one.mass_share,
            inertia=np.asarray(link.inertia) * one.mass_share,
            damping=one.damping,
            friction=one.friction,
            stiffness=max(one.stiffness, NO_SPRING) if sprung else 0.0,
            rest=one.pull / one.stiffness if one.stiffness else 0.0,
        )
        for link, one in zip(links, known, strict=True)
    ]
    model = tree_of(started, control_period=period, substeps=SUBSTEPS)
    centres = _centres(model, np.array([one.offset for one in known]))
    model = with_values(model, {name: jnp.asarray(one) for name, one in centres.items()})
    # the shape of a part says where its mass is; how much there is, and what resists, was felt
    changes: dict = {name: {"fixed": True} for name in ("gyration", "centre_of_mass")}
    changes |= {name: {"prior": LogNormal(None, 1.0)} for name in ("mass", "damping", "friction")}
    if sprung:
        changes["stiffness"] = {"fixed": False, "prior": LogNormal(None, 1.0)}
        changes["rest"] = {"fixed": False}
    return declare(model, **changes)


def _centres(
    model: Articulated, moved: Float[np.ndarray, "*draws links 3"]
) -> dict[str, Float[np.ndarray, "..."]]:
    """Centres of mass that have `moved` (m), and radii of gyration with which the inertia of each
    link about its hinge, which was felt, stays as it is. None goes further out than that allows."""
    axis, centre = np.asarray(model.axis), np.asarray(model.centre_of_mass)
    shape = np.einsum("li,lij,lj->l", axis, np.asarray(model.shape_inertia), axis)
    own = shape * np.square(np.asarray(model.gyration))
    arm = np.square(np.cross(axis, centre)).sum(axis=-1)
    along = np.sum((centre + moved) * axis, axis=-1, keepdims=True) * axis
    across = centre + moved - along
    most = arm + (1.0 - SMALLEST) * own
    size = np.square(across).sum(axis=-1)
    across = across * np.sqrt(np.minimum(most / np.maximum(size, most), 1.0))[..., None]
    left = own + arm - np.square(across).sum(axis=-1)
    return {"centre_of_mass": along + across, "gyration": np.sqrt(left / shape)}
