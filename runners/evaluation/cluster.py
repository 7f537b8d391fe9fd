"""The Dask cluster that does the tasks of an evaluation: our own, one that runs, or SLURM's."""

from __future__ import annotations

import importlib.util
import logging
import os
import socket
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from chsel.errors import SettingError, require_choice
from chsel.numerics.threads import require_threads
from chsel.problem.settings import CheckedSettings, build_settings, positive, settings_mapping
from runners.command.choices import store

if TYPE_CHECKING:
    from distributed import Client

_DASK = {
    "distributed.scheduler.allowed-failures": 1,  # the second worker that a task kills is the last
    "distributed.scheduler.worker-ttl": None,  # a long task may keep a worker from answering
    "distributed.deploy.lost-worker-timeout": "5 minutes",  # for a worker to start again
}
_PRELOAD = "runners.evaluation.tasks"
_LOOPBACK = "127.0.0.1"
_LOCAL_PORT = f"{_LOOPBACK}:0"  # any free port, for this machine alone
_CONNECT = 30.0  # s


@dataclass(frozen=True)
class LocalConfig:
    """Workers on this machine, or a cluster that somebody else has started."""

    kind: str = "local"
    scheduler: str | None = None  # such as tcp://127.0.0.1:8786; None: workers of our own
    dashboard: bool = False  # Dask's, of workers of our own, for everybody on this machine


@dataclass(frozen=True)
class SlurmConfig(CheckedSettings):
    """Workers in jobs of SLURM, each of one core; None leaves a setting to SLURM."""

    kind: str = "slurm"
    jobs: Annotated[int, positive] = 1
    processes: Annotated[int, require_threads] = 1  # workers of a job, one core each
    memory: str = "4GB"  # of a job
    walltime: str = "12:00:00"  # of a job
    queue: str | None = None  # the partition
    account: str | None = None
    interface: str | None = None  # of the network by which jobs reach this machine, such as ib0
    directives: tuple[str, ...] = ()  # further #SBATCH options, such as --constraint=fast
    prologue: tuple[str, ...] = ()  # lines of the shell before a worker starts
    python: str | None = None  # on the nodes; None: this one
    log_directory: str | None = None  # of the jobs' output; None: where the command runs
    dashboard: bool = False


ClusterConfig = LocalConfig | SlurmConfig
CLUSTERS: dict[str, type[LocalConfig] | type[SlurmConfig]] = {
    "local": LocalConfig,
    "slurm": SlurmConfig,
}
for _name, _settings in CLUSTERS.items():
    store("cluster", _name, settings_mapping(_settings()))


def cluster_config(values: Mapping[str, Any], workers: int | None) -> ClusterConfig:
    """The choice `cluster`, checked. workers: how many are wanted here, None if that is open."""
    kind = str(values.get("kind"))
    require_choice("cluster.kind", kind, CLUSTERS)
    config = build_settings(CLUSTERS[kind], values, "cluster")
    here = isinstance(config, LocalConfig) and not config.scheduler
    if workers is not None and not here:
        raise SettingError(
            f"workers is {workers}, which is of this machine; accepted with another cluster: null"
        )
    if kind == "slurm" and importlib.util.find_spec("dask_jobqueue") is None:
        raise SettingError("cluster=slurm needs dask-jobqueue: pip install -e '.[slurm]'")
    return config


@contextmanager
def connected(
    config: ClusterConfig, workers: int | None, say: Callable[[str], None]
) -> Iterator[tuple[Client, int]]:
    """A client of the cluster, which ends with the context if it was started for it, and its size.

    workers: of this machine, None for one a core. say: shows a line.
    """
    import dask
    from distributed import Client

    with dask.config.set(_DASK):
        if isinstance(config, LocalConfig) and config.scheduler:
            with _client_of(config.scheduler) as client:
                say(f"workers of the Dask scheduler at {config.scheduler}")
                yield client, _checked_size(client)
            return
        if isinstance(config, SlurmConfig):
            size = config.jobs * config.processes
            started = slurm_cluster(config)
        else:
            size = workers or _cores()
            started = _local_cluster(size, dashboard=config.dashboard)
        with started as cluster, Client(cluster) as client:
            if isinstance(config, SlurmConfig):  # another job starts in place of one that is lost
                cluster.adapt(minimum_jobs=config.jobs, maximum_jobs=config.jobs)
            if config.dashboard:
                say(f"dashboard: {cluster.dashboard_link}")
            yield client, size


def _checked_size(client: Client) -> int:
    """How many workers a running cluster has. Raises SettingError if one has several threads."""
    threads = client.nthreads().values()
    if max(threads, default=1) > 1:
        raise SettingError(
            f"a worker has {max(threads)} threads; accepted: one, as of `dask worker "
            "--nthreads 1 --nworkers NUMBER`"
        )
    return max(1, len(threads))


def slurm_cluster(config: SlurmConfig) -> Any:
    """A cluster whose workers are in jobs; it has none until it is scaled."""
    from dask_jobqueue import SLURMCluster

    return SLURMCluster(
        cores=config.processes,
        processes=config.processes,
        memory=config.memory,
        walltime=config.walltime,
        queue=config.queue,
        account=config.account,
        interface=config.interface,
        job_extra_directives=list(config.directives),
        job_script_prologue=["export NUMBA_NUM_THREADS=1", *config.prologue],
        log_directory=config.log_directory,
        scheduler_options={"dashboard_address": _LOCAL_PORT, "dashboard": config.dashboard},
        worker_extra_args=["--preload", _PRELOAD],
        python=config.python or sys.executable,
    )


def _local_cluster(workers: int, *, dashboard: bool) -> Any:
    """Processes of one thread and no limit of memory each, for this machine alone."""
    from distributed import LocalCluster

    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        memory_limit=0,
        host=_LOOPBACK,
        security=True,  # TLS with keys of this run: other users of the machine can reach the ports
        dashboard_address=_LOCAL_PORT,
        scheduler_kwargs={"dashboard": dashboard},
        silence_logs=logging.CRITICAL,
        preload=[_PRELOAD],
        env={"NUMBA_NUM_THREADS": "1"},  # Dask sets those of OpenMP, MKL and OpenBLAS
    )


@contextmanager
def _client_of(address: str) -> Iterator[Client]:
    from distributed import Client
    from distributed.comm import get_address_host_port

    try:  # Dask's client would try for long, and wait for a minute when it is given up
        socket.create_connection(get_address_host_port(address), timeout=_CONNECT).close()
        client = Client(address, timeout=_CONNECT)
    except (OSError, ValueError) as error:
        raise SettingError(
            f"cluster.scheduler is {address} ({' '.join(str(error).split())}); accepted: the "
            f"address of a running Dask scheduler, such as tcp://{_LOOPBACK}:8786"
        ) from error
    with client:
        yield client


def _cores() -> int:
    """How many processes this one may use at a time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
