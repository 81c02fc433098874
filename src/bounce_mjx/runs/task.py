"""The copy of a task's file in the run that trains it, in the run's folder `task`; and that of an
algorithm's file, in `algorithm`.

A run of a task of the package, or of an installed one, has no copy.
"""

import shlex
import sys
from pathlib import Path

from bounce_mjx.errors import UserError
from bounce_mjx.runs.files import write_atomically
from bounce_mjx.task.task import Task
from bounce_mjx.tasks import registry

TASK = "task"


def copy_code(name: str, run: Path, folder: str = TASK) -> str:
    """Copies the file of a task or an algorithm, FILE.py:CLASS, into a run's folder, unless the run
    has a copy.

    Returns:
      The copy's FILE.py:CLASS, relative to the run's folder.

    Raises:
      OSError: the copy cannot be written.
      UserError: the file cannot be read.
    """
    file = f"{folder}/{registry.source_file(name).name}"
    if not (run / folder).exists():
        (run / folder).mkdir()
        write_atomically(run / file, registry.read_source(name))
    return f"{file}:{name.rpartition(':')[2]}"


def task_of_run(name: str, run: Path, given: str | None) -> type[Task]:
    """The task of a run; its copy of a task's file is not run unless the user has named code with
    the same content.

    Args:
      name: name in the run's config.
      given: name that the user gave, or None. Another file's task is taken with a warning.

    Raises:
      UserError: the user has not named the file; or the run has another task.
    """
    differs = given is not None and not is_same_task(name, given)
    if not registry.is_file(name):
        if differs:
            raise UserError(
                f"the run {run} was trained with the task {name}, but --task is {given}; leave it "
                "out"
            )
        return registry.find_task(name)
    if differs:
        print(
            f"warning: {given} differs from the task that {run} was trained with; the "
            f"training's is {name}",
            file=sys.stderr,
        )
    if given is not None:
        registry.admit(name, registry.find_task(given))
    task = registry.known_task(name)
    if task is None:
        raise UserError(
            f"the run {run} was trained with a task in a file, which is code; name it to run it: "
            f"--task FILE.py:{name.rpartition(':')[2]} (the run's copy is {shlex.quote(name)})"
        )
    return task


def is_same_task(name: str, given: str) -> bool:
    """Whether two names stand for equal code."""
    return registry.code_of(name) == registry.code_of(given)


def identify_task(name: str) -> str:
    """A task's name; for FILE.py:CLASS without the folder, and with eight digits of the hash."""
    if not registry.is_file(name):
        return name
    digest, attribute = registry.code_of(name)
    return f"{registry.source_file(name).name}:{attribute} {digest[:8]}"
