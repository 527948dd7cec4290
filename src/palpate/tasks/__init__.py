"""What is wanted: goal, loss, success and start states."""

from palpate.tasks.task import Start as Start
from palpate.tasks.task import Task as Task
