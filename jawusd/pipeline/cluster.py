"""The workers that many builds are shared among: processes of this machine, or a Dask cluster that is already there."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import dask
from distributed import Client, LocalCluster, Security, Worker, WorkerPlugin
from distributed.comm import connect
from distributed.utils import silence_logging_cmgr

from jawusd import __version__
from jawusd.errors import ClusterError

CONNECT_SECONDS = 10
_LOOPBACK = "127.0.0.1"


class _IgnoreInterrupt(WorkerPlugin):
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that knows what to do."""

    def setup(self, worker: Worker) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def local_cluster(workers: int, retries: int) -> Iterator[Client]:
    """Start worker processes of one thread each that listen to this machine alone; none is left when the block ends.

    Args:
        workers: how many.
        retries: how often work is given to another worker when one died over it.

    Yields:
        A client of them.
    """
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": retries}),
        tempfile.TemporaryDirectory(prefix="jawusd-") as scratch,
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host=_LOOPBACK,
            # No dashboard; without an address of its own the server for it would insist on one port.
            dashboard_address=f"{_LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
            memory_limit=0,  # a share of the memory says nothing of what a build needs; the system judges
            silence_logs=logging.CRITICAL,
            local_directory=scratch,
        ) as cluster,
        Client(cluster) as client,
    ):
        client.register_plugin(_IgnoreInterrupt())
        yield client


@contextlib.contextmanager
def existing_cluster(address: str) -> Iterator[Client]:
    """Connect to a scheduler.

    Args:
        address: as "tcp://host:8786".

    Yields:
        A client of it.

    Raises:
        ClusterError: nothing answers there, or it has no worker.
    """
    try:
        asyncio.run(_greet(address))
    except (OSError, ValueError, TypeError, MemoryError) as error:
        raise ClusterError(
            f"no scheduler answers at {address} ({str(error) or 'something listens and says nothing'}).",
            hint="Start one with: dask scheduler, and workers with: dask worker ADDRESS --nthreads 1",
        ) from error
    with silence_logging_cmgr(logging.CRITICAL), Client(address, timeout=CONNECT_SECONDS) as client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError as error:
            raise ClusterError(
                f"the scheduler at {address} has no worker.", hint="Start some with: dask worker ADDRESS --nthreads 1"
            ) from error
        yield client


async def _greet(address: str) -> None:
    """Exchange greetings with a scheduler; a client would wait for ever where something listens but does not answer."""
    arguments = Security().get_connection_args("client")
    async with asyncio.timeout(CONNECT_SECONDS + 1):
        comm = await connect(address, timeout=CONNECT_SECONDS, **arguments)
        await comm.close()


def check_workers(client: Client, folder: Path) -> None:
    """Check that every worker runs this version of jawusd and sees the output folder.

    Args:
        client: connected to the cluster.
        folder: the output folder, which workers write to.

    Raises:
        ClusterError: a worker cannot build here.
    """
    for address, answer in client.run(_look, str(folder), on_error="return").items():
        if isinstance(answer, Exception):
            raise ClusterError(f"worker {address} cannot run jawusd ({type(answer).__name__}: {answer}).")
        version, sees_folder = answer
        if version != __version__:
            raise ClusterError(f"worker {address} has jawusd {version}, here it is {__version__}.")
        if not sees_folder:
            raise ClusterError(
                f"worker {address} does not see {folder}.", hint="Use a folder that all machines share, by one path."
            )


def _look(folder: str) -> tuple[str, bool]:
    return __version__, Path(folder).is_dir()
