"""The toys as a family of another package: what its entry point would name."""

from palpate.family import Family

FAMILY = Family(
    name="toys",
    about="a cart, a pendulum and a sled",
    models={
        "cart": "toys:Cart",
        "pendulum": "toys:Pendulum",
        "sled": "bayesian_toys:Sled",
    },
    tasks={
        "cart-to-origin": "toys:CartToOrigin",
        "pendulum-damping": "toys:PendulumDamping",
    },
    evidence={"swing": "toy_pendulum:SWING"},
    options={
        "record": {"toy-pendulum": "toy_pendulum:RecordPendulum"},
        "identify": {"toy-pendulum": "toy_pendulum:IdentifyPendulum"},
        "train": {"pendulum-damping": "toy_pendulum:TrainPendulumDamping"},
        "evaluate": {"pendulum-damping": "toy_pendulum:EvaluatePendulumDamping"},
    },
)
