"""What is wanted: one file per task, and their names."""

from palpate.errors import PalpateError
from palpate.tasks.rope_stabilization import RopeStabilization as RopeStabilization
from palpate.tasks.rope_tracking import RopeTracking as RopeTracking
from palpate.tasks.task import Start as Start
from palpate.tasks.task import Task as Task

TASKS: dict[str, type[Task]] = {task.name: task for task in (RopeStabilization, RopeTracking)}


def task_named(name: str) -> type[Task]:
    """The class of a task by the name that the command line and manifests use."""
    if name not in TASKS:
        raise PalpateError(f"unknown task '{name}'; there are: {', '.join(sorted(TASKS))}")
    return TASKS[name]
