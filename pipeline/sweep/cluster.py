"""A sweep's jobs on other machines: on a Dask scheduler, by its address, and what SLURM's launcher lacks; as a program, one job on a Dask worker.

Each job is a process of its own on the worker, so that what it does to libraries, or a crash, reaches no other. The sweep's folder and the data
sets are at the same paths on all machines; what comes back are the files, through the file system.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from trihedron.pipeline.core.errors import ConfigError
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.sweep.jobs import DONE, FAILED, read_job, write_job

ANSWER_SECONDS = 5.0  # a scheduler that is there answers within one
PLACE = "hydra.launcher.address"


class Dask(Launcher):
    """Hydra's launcher that gives a sweep's jobs to the workers of a running Dask scheduler."""

    def __init__(self, address: str) -> None:
        self.address = address

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keep what every job needs; Hydra calls it."""
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        """Run the jobs and wait for them. Raises ConfigError when nobody answers at the address."""
        with _connect_client(self.address) as client:
            if not client.scheduler_info()["workers"]:
                print(f"sweep: the scheduler at {self.address} has no worker yet; waiting for one", file=sys.stderr)
            jobs = [self._pack_job(list(words), initial_job_idx + number) for number, words in enumerate(job_overrides)]
            calls = client.map(run_apart, jobs, self._folders(job_overrides), [str(Path.cwd())] * len(jobs), pure=False)
            client.gather(calls, errors="skip")
        return []

    def _pack_job(self, words: list[str], number: int) -> bytes:
        """All that a job needs, to be read by `main`."""
        with imports_of("cloudpickle"):
            import cloudpickle

        packed: bytes = cloudpickle.dumps((number, words, self.hydra_context, self.config, self.task_function, Singleton.get_state()))
        return packed

    def _folders(self, jobs: Sequence[Sequence[str]]) -> list[str]:
        names = [next(word.partition("=")[2] for word in words if word.startswith("hydra.sweep.subdir=")) for words in jobs]
        return [str(Path(str(self.config.hydra.sweep.dir)).absolute() / name) for name in names]


def _connect_client(address: str) -> Any:
    """A client of the scheduler. Raises ConfigError, LibraryError."""
    if not address:
        raise ConfigError(PLACE, "is not given", f"give {PLACE}=tcp://HOST:8786, where `dask scheduler` runs")
    with imports_of("distributed"):
        from distributed import Client
    try:
        return Client(address, timeout=ANSWER_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        cause = f"no Dask scheduler answers at {address}"
        raise ConfigError(PLACE, cause, f"start `dask scheduler`, and `dask worker {address}` on each machine") from error


def run_apart(job: bytes, folder: str, working_folder: str) -> None:
    """Run a packed job in a process of its own, on the worker; one that crashes leaves the reason in its folder."""
    done = subprocess.run([sys.executable, "-m", __name__], input=job, cwd=working_folder, capture_output=True)
    if done.returncode and read_job(Path(folder)).get("state") not in (DONE, FAILED):
        last = next(iter(reversed(done.stderr.decode(errors="replace").strip().splitlines())), "")
        write_job(Path(folder), "", FAILED, f"{folder}: the job's process ended with {done.returncode}: {last}")


@contextmanager
def all_awaited() -> Iterator[None]:
    """Within it submitit, through which Hydra asks SLURM, waits for all jobs of a sweep; else it leaves at the first whose process died."""
    try:
        import submitit
        from submitit.core.utils import UncompletedJobError
    except ImportError:
        yield
        return
    Job: Any = submitit.Job
    results = Job.results

    def results_or_none(job: Any) -> list[Any]:
        try:
            return list(results(job))
        except UncompletedJobError:
            return [None]

    Job.results = results_or_none
    try:
        yield
    finally:
        Job.results = results


def main() -> None:
    """Read a packed job from standard input and run it."""
    import cloudpickle
    from hydra_plugins.hydra_joblib_launcher._core import execute_job

    execute_job(*cloudpickle.load(sys.stdin.buffer))


if __name__ == "__main__":
    main()
