"""Ropes: deformable linear objects, held at one end or both."""

from palpate.family import Family

_OPTIONS, _CONTROL = "palpate.families.rope.options", "palpate.families.rope.control_options"
_EXPERIMENTS = "palpate.experiments.rope"

FAMILY = Family(
    name="rope",
    about="deformable linear objects",
    models={"rope": "palpate.models.rope:Rope"},
    tasks={
        "rope-stabilization": "palpate.tasks.rope:RopeStabilization",
        "rope-tracking": "palpate.tasks.rope:RopeTracking",
    },
    evidence={"energy": "palpate.families.rope.energy:ENERGY"},
    deployments={"rope-stabilization": "palpate.families.rope.deployment:RopeDeployment"},
    options={
        "demo": {"rope": "palpate.families.rope.demo:DemoRope"},
        "record": {"rope": f"{_OPTIONS}:RecordRope"},
        "track": {"rope": f"{_OPTIONS}:TrackRope"},
        "identify": {"rope": f"{_OPTIONS}:IdentifyRope"},
        "train": {
            "rope-stabilization": f"{_CONTROL}:TrainRopeStabilization",
            "rope-tracking": f"{_CONTROL}:TrainRopeTracking",
        },
        "evaluate": {
            "rope-stabilization": f"{_CONTROL}:EvaluateRopeStabilization",
            "rope-tracking": f"{_CONTROL}:EvaluateRopeTracking",
        },
    },
    experiments={
        "rope-model": f"{_EXPERIMENTS}.model:reproduce",
        "rope-stabilization": f"{_EXPERIMENTS}.stabilization:reproduce",
        "rope-ablation": f"{_EXPERIMENTS}.ablation:reproduce",
        "rope-rivals": f"{_EXPERIMENTS}.rivals:reproduce",
        "rope-bound": f"{_EXPERIMENTS}.bound:reproduce",
        "rope-generalization": f"{_EXPERIMENTS}.generalization:reproduce",
        "rope-tracking": f"{_EXPERIMENTS}.tracking:reproduce",
        "rope-dagger": f"{_EXPERIMENTS}.dagger:reproduce",
        "rope-posterior": f"{_EXPERIMENTS}.posterior:reproduce",
        "own-rope": f"{_EXPERIMENTS}.own_rope:reproduce",
        "rope-residual": f"{_EXPERIMENTS}.residual:reproduce",
        "rope-markerless": f"{_EXPERIMENTS}.markerless:reproduce",
    },
)
