"""`palpate demo`: the whole loop once, small enough to watch.

An object is recorded and identified, a controller is trained through what was identified and tried
in other objects; the stages are the commands of the same names, each in a folder below the demo's.
"""

from pathlib import Path

from palpate.commands import evaluate, folders, identify, record, train
from palpate.families.options import Demo
from palpate.report import build_report
from palpate.runs import Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.runs.storage import write_json


def run(options: Demo) -> Path:
    """All stages, what they found in a few lines, one report; returns the folder.

    A stage that is finished is not done again.
    """
    out = options.out or folders.RUNS / "demo"
    print(f"demo: about {options.minutes} minutes on two cores, written to {out}", flush=True)
    if options.fresh and out.is_dir():
        folders.start_over(out, "demo")
    recorded, identified, trained, evaluated = options.stages(
        out, out / "record" / folders.RECORDING
    )
    stages = [
        record.run(recorded).parent,
        identify.run(identified),
        train.run(trained),
        evaluate.run(evaluated),
    ]
    results = [read_result(stage / RESULT) for stage in stages]
    found = options.summarise(stages[1], stages[3], out)
    result = Result(
        name="demo",
        figures=found.figures,
        settings=found.settings,
        seeds=sorted({seed for result in results for seed in result.seeds}),
        split=found.split,
        wall_time_s=sum(result.wall_time_s for result in results),
    )
    write_json(out / RESULT, result.to_dict())
    build_report([out, *stages], out / folders.REPORT, options.title)
    print("\n".join(["", *found.lines]))
    print(f"report: {out / folders.REPORT}")
    return out
