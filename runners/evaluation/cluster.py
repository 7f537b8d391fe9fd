"""The Dask cluster that does the tasks of an evaluation: our own, one that runs, or SLURM's."""

from __future__ import annotations

import importlib.util
import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from chsel.errors import SettingError, require_choice, require_positive
from chsel.numerics.threads import require_threads
from chsel.problem.settings import build_settings

_DASK = {
    "distributed.scheduler.allowed-failures": 1,  # the second worker that a task kills is the last
    "distributed.scheduler.worker-ttl": None,  # a long task may keep a worker from answering
    "distributed.scheduler.work-stealing": False,  # no worker has a task that it does not do
    "distributed.deploy.lost-worker-timeout": "5 minutes",  # until a worker is taken for lost
    "distributed.admin.large-graph-warning-threshold": "1GB",  # files travel with tasks
}
_PRELOAD = "runners.evaluation.tasks"
_LOOPBACK = "127.0.0.1"
_LOCAL_PORT = f"{_LOOPBACK}:0"  # any free port, for this machine alone
_CONNECT = 30.0  # s
_PATIENCE = 60.0  # s, before a worker that is not there is given up


@dataclass(frozen=True)
class LocalConfig:
    """Workers on this machine, or a cluster that somebody else has started."""

    kind: str
    scheduler: str | None  # address of a running Dask scheduler; None: workers of our own
    dashboard: bool  # whether workers of our own have one


@dataclass(frozen=True)
class SlurmConfig:
    """Workers in jobs of SLURM, each of one core; None leaves a setting to SLURM."""

    kind: str
    jobs: int
    processes: int  # workers of a job
    memory: str  # of a job, such as 32GB
    walltime: str  # of a job, H:MM:SS
    queue: str | None  # the partition
    account: str | None
    interface: str | None  # of the network by which jobs reach this machine, such as ib0
    directives: Any  # a list of further #SBATCH options
    prologue: Any  # a list of lines of the shell before a worker starts
    python: str | None  # on the nodes; None: this one
    log_directory: str | None  # of the jobs' output
    dashboard: bool

    def __post_init__(self) -> None:
        require_positive("jobs", self.jobs)
        require_threads("processes", self.processes)
        for name in ("directives", "prologue"):
            lines = getattr(self, name)
            if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
                raise SettingError(f"{name} is {lines!r}; accepted: a list of texts")


@dataclass(frozen=True)
class Connection:
    """A cluster to work on."""

    client: Any  # of Dask
    restore: Callable[[], object] = lambda: None  # starts workers in place of those that are lost


ClusterConfig = LocalConfig | SlurmConfig
_KINDS: dict[str, type[LocalConfig] | type[SlurmConfig]] = {
    "local": LocalConfig,
    "slurm": SlurmConfig,
}


def cluster_config(values: Mapping[str, Any], workers: int | None) -> ClusterConfig:
    """The choice `cluster`, checked. workers: how many are wanted here, None if that is open."""
    kind = str(values.get("kind"))
    require_choice("cluster.kind", kind, _KINDS)
    config = build_settings(_KINDS[kind], values, "cluster")
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
) -> Iterator[Connection]:
    """Connect to the cluster; one that was started for it ends with the context.

    workers: of this machine, None for one a core. say: shows a line.
    """
    import dask
    from distributed import Client

    with dask.config.set(_DASK):
        if isinstance(config, LocalConfig) and config.scheduler:
            with _client_of(config.scheduler) as client:
                say(f"workers of the Dask scheduler at {config.scheduler}")
                yield Connection(client)
            return
        if isinstance(config, SlurmConfig):
            started, size = slurm_cluster(config), {"jobs": config.jobs}
        else:
            size = {"n": workers or _cores()}
            started = _local_cluster(size["n"], dashboard=config.dashboard)
        with started as cluster, Client(cluster, set_as_default=False) as client:
            restore: Callable[[], object] = partial(cluster.scale, **size)
            restore()
            if isinstance(config, LocalConfig):
                restore = _LocalWorkers(cluster, client, size["n"]).restore
            if config.dashboard:
                say(f"dashboard: {cluster.dashboard_link}")
            yield Connection(client, restore)


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


@dataclass
class _LocalWorkers:
    """The workers of this machine: others start in place of those that are lost.

    Dask does so itself where a worker was killed, but not where it ended itself, as over a task
    that it could not read. So those that stay away are given up: scaling down takes them first.
    """

    cluster: Any  # of Dask
    client: Any  # of Dask
    count: int
    missing: int = 0
    since: float = 0.0  # from when so many have been missing

    def restore(self) -> None:
        """Start workers in place of those that are lost."""
        there = len(self.client.nthreads())
        if self.count - there != self.missing:
            self.missing, self.since = self.count - there, time.monotonic()
        if self.missing > 0 and time.monotonic() - self.since >= _PATIENCE:
            self.missing = 0
            self.cluster.scale(there)  # the next call starts others, which may have the same names
        else:
            self.cluster.scale(self.count)


@contextmanager
def _client_of(address: str) -> Iterator[Any]:
    from distributed import Client
    from distributed.comm import get_address_host_port

    try:  # Dask's client would try for long, and wait for a minute when it is given up
        socket.create_connection(get_address_host_port(address), timeout=_CONNECT).close()
        client = Client(address, set_as_default=False, timeout=_CONNECT)
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
