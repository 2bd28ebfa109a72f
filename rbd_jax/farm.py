"""Layer 9: many independent rollouts on the workers of a Ray cluster, or of this machine.

A task is a number or whatever says which rollouts to do; the same function gives the same arrays for it in any process,
so a task whose worker dies is done again and counted once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .checks import whole
from .spread import use_cores


class TaskFailed(RuntimeError):
    """A task raised, or its workers died more often than allowed.

    Attributes:
      index: of the task. results: by index, of all tasks that were done by then.
    """

    def __init__(self, text: str, index: int, results: dict):
        super().__init__(text)
        self.index, self.results = index, results


def farm(
    simulate: Callable,
    tasks: Sequence,
    workers: int = 2,
    cores: int = 1,
    retries: int = 3,
    report: Callable[[int, int], None] | None = None,
) -> list:
    """``[simulate(task) for task in tasks]``, computed by Ray (``pip install 'rbd-jax[farm]'``).

    Args:
      simulate: task -> pytree of numpy arrays. It runs in other processes and must depend on its task alone (draw
        random numbers from a seed in it). What it compiles is kept by its worker for the next task.
      tasks: what Ray can send, one entry a task; many worlds a task pay, since a task costs some milliseconds.
      workers: processes at a time on this machine; a cluster that ``ray.init`` was called for has its own number.
      cores: of a CPU, for each.
      retries: how often a task is done again after its worker died.
      report: called with (tasks done, tasks) after each.

    Returns:
      The results in the order of ``tasks``, whichever worker did them.

    Raises:
      ValueError: ``workers`` or ``cores`` is not an integer >= 1, or ``retries`` not one >= 0.
      ImportError: Ray is not installed.
      TaskFailed: with what was done by then.
    """
    for name, value, least in (("workers", workers, 1), ("cores", cores, 1), ("retries", retries, 0)):
        if not whole(value, least):
            raise ValueError(f"farm: {name} = {value!r} must be an integer >= {least}")
    try:
        import ray
    except ImportError as error:
        raise ImportError("farm needs Ray: pip install 'rbd-jax[farm]'") from error
    mine = not ray.is_initialized()
    if mine:
        ray.init(num_cpus=workers * cores, include_dashboard=False, log_to_driver=False, configure_logging=False)

    def one(task):
        use_cores(cores)
        return simulate(task)

    done = {}
    try:
        remote = ray.remote(num_cpus=cores, max_retries=retries)(one)
        waiting = {remote.remote(task): k for k, task in enumerate(tasks)}
        while waiting:
            (ready,), _ = ray.wait(list(waiting), num_returns=1)
            k = waiting.pop(ready)
            try:
                done[k] = ray.get(ready)
            except ray.exceptions.RayError as error:
                for other in waiting:
                    ray.cancel(other)
                cause = getattr(error, "cause", None) or error
                text = f"task {k} ({tasks[k]!r}) failed; {len(done)} of {len(tasks)} were done"
                text = f"farm: {text}: {type(cause).__name__}: {cause}"
                raise TaskFailed(text, k, done) from error
            if report is not None:
                report(len(done), len(tasks))
    finally:
        if mine:
            ray.shutdown()
    return [done[k] for k in range(len(tasks))]
