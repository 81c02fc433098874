"""The copy of a task's file in the run that trains it.

    runs/<task>/<time stamp>/task/
        my_task.py          the file
        manifest.json       its size and SHA-256

A run of a task of the package, or of an installed one, has no copy.
"""

import shlex
import sys
from pathlib import Path

from bounce_mjx.errors import UserError
from bounce_mjx.runs.files import check_copy, seal, write_atomically
from bounce_mjx.task.task import Task
from bounce_mjx.tasks import registry

TASK = "task"


def copy_task(name: str, run: Path) -> str:
    """Copies the file of a task FILE.py:CLASS into a run's folder, unless the run has a copy.

    Returns:
      The copy's FILE.py:CLASS, relative to the run's folder.

    Raises:
      OSError: the copy cannot be written.
      UserError: the file cannot be read.
    """
    path, attribute = registry.source_file(name), name.rpartition(":")[2]
    folder = run / TASK
    if not folder.exists():
        folder.mkdir()
        write_atomically(folder / path.name, registry.read_source(name))
        seal(folder)
    return f"{TASK}/{path.name}:{attribute}"


def task_of_run(name: str, run: Path, given: str | None) -> type[Task]:
    """The task of a run; its copy of a task's file is not run unless the user has named code with
    the same content.

    Args:
      name: name in the run's config.
      given: name that the user gave, or None. Another file's task is taken with a warning.

    Raises:
      UserError: the user has not named the file; or the run has another task, or its copy was
        edited.
    """
    if not registry.is_file(name):
        task = registry.find_task(name)
        if given is not None and registry.find_task(given) is not task:
            raise UserError(
                f"the run {run} was trained with the task {name}, but --task is {given}; leave it "
                "out"
            )
        return task
    check_copy(registry.source_file(name), run / TASK, "--task")
    if given is not None:
        task = registry.find_task(given)
        if not is_same_task(name, given):
            print(
                f"warning: {given} differs from the task that {run} was trained with; the "
                f"training's is {name}",
                file=sys.stderr,
            )
        registry.admit(name, task)
    task = registry.known_task(name)
    if task is None:
        raise UserError(
            f"the run {run} was trained with a task in a file, which is code; name it to run it: "
            f"--task FILE.py:{name.rpartition(':')[2]} (the run's copy is {shlex.quote(name)})"
        )
    return task


def is_same_task(name: str, given: str) -> bool:
    """Whether two names stand for equal code."""
    if registry.is_file(name) and registry.is_file(given):
        return registry.content_of(name) == registry.content_of(given)
    return registry.find_task(name) is registry.find_task(given)


def identify_task(name: str) -> str:
    """A task's name; for FILE.py:CLASS without the folder, and with eight digits of the hash."""
    if not registry.is_file(name):
        return name
    digest, attribute = registry.content_of(name)
    return f"{registry.source_file(name).name}:{attribute} {digest[:8]}"
