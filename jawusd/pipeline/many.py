"""Build many captures in worker processes or on a Dask cluster, and write one table of outcomes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import signal
import tempfile
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import dask
from dask.system import CPU_COUNT
from distributed import Client, Future, LocalCluster, Security, Worker, WorkerPlugin, as_completed, get_worker, wait
from distributed.comm import connect
from distributed.utils import silence_logging_cmgr

from jawusd.base.errors import ClusterError, JawusdError
from jawusd.base.guard import map_large_arrays
from jawusd.base.version import __version__
from jawusd.formats.atomic import write_csv_atomic, write_text_atomic
from jawusd.formats.capture_list import ListedCapture
from jawusd.pipeline.build import BuildOptions, FitSummary, build
from jawusd.pipeline.state import Progress, make_folder
from jawusd.pipeline.workspace import check_folder

SUMMARY_JSON, SUMMARY_CSV = "builds.json", "builds.csv"
BUILT, KEPT, FAILED, STOPPED = "built", "kept", "failed", "stopped"

#: Callback that is called with one line of text per event.
Notify = Callable[[str], None]

_NOTIFY_SECONDS = 10.0  # minimum interval between two lines about the same stage of a capture
_STOP_SECONDS = 15.0  # time within which running builds must stop after a cancellation
CONNECT_SECONDS = 10
_LOOPBACK = "127.0.0.1"

# Ids of cancelled runs; a worker may serve several runs.
_cancelled: set[str] = set()


class _CancelledError(Exception):
    """Raised on a worker whose run was cancelled."""


@dataclass(frozen=True)
class ManyOptions:
    """Options for building many captures."""

    build: BuildOptions  # options for every build
    cluster: str | None = None  # address of a Dask scheduler; None: local processes
    workers: int | None = None  # number of local processes; None: one per core, at most one per capture
    #: number of retries of a capture after its process died; an existing scheduler uses its own setting
    retries: int = 3


@dataclass(frozen=True)
class Outcome:
    """Outcome of one build."""

    name: str  # name of the output folder
    capture: str  # path of the capture
    status: str  # "built", "kept" (nothing changed since an earlier build), "failed" or "stopped"
    frames: int | None = None
    tracked: int | None = None  # number of frames with both arches tracked
    model_mm: float | None = None  # mean over frames of the maximum error over the mandible's vertices [mm]
    holdout_mm: float | None = None  # the same mean, over held-out frames [mm]
    sigma_incisor_mm: float | None = None  # median standard deviation of the tracked incisal point [mm]
    seconds: float | None = None  # total duration of the stages
    error: str | None = None  # reason for the failure; None if the build did not fail


def build_many(captures: Sequence[ListedCapture], root: Path, options: ManyOptions, notify: Notify) -> list[Outcome]:
    """Build the rig of every capture in its own folder below `root`; a failure does not stop the others.

    The outcomes, in the order of the captures, are written to builds.json and builds.csv, even after an interrupt.
    `root` must have the same path on every worker.

    Raises:
        OutputError: an output folder contains a build and neither `resume` nor `fresh` is set, or cannot be created.
        ClusterError: the cluster is unusable.
    """
    root = root.resolve()
    for item in captures:
        check_folder(root / item.name, resume=options.build.resume, fresh=options.build.fresh)
    make_folder(root)
    if options.cluster is None:
        cluster = local_cluster(options.workers or min(CPU_COUNT, len(captures)), options.retries)
    else:
        cluster = existing_cluster(options.cluster)
    found: dict[str, Outcome] = {}
    with cluster as client:
        check_workers(client, root)
        try:
            for outcome in _run(client, captures, root, options.build, notify):
                found[outcome.name] = outcome
                said = f"[{len(found)}/{len(captures)}] {outcome.name}: {outcome.error or outcome.status}"
                for line in said.split("\n"):
                    notify(line)
        finally:
            outcomes = [found.get(c.name, Outcome(c.name, str(c.path), STOPPED)) for c in captures]
            rows = [asdict(outcome) for outcome in outcomes]
            text = json.dumps({"format": "jawusd-builds/1", "builds": rows}, indent=1)
            write_text_atomic(root / SUMMARY_JSON, text + "\n")
            write_csv_atomic(root / SUMMARY_CSV, [field.name for field in fields(Outcome)], rows)
    return outcomes


def _run(
    client: Client, captures: Sequence[ListedCapture], root: Path, options: BuildOptions, notify: Notify
) -> Iterator[Outcome]:
    """Yield outcomes as the builds end; on an interrupt, cancel the running builds."""
    run = uuid.uuid4().hex
    # After a worker has died, the retry reuses the stages that the worker finished.
    options = options if options.fresh else replace(options, resume=True)
    with contextlib.ExitStack() as stack:
        client.subscribe_topic(run, lambda event: notify(event[1]))
        stack.callback(client.unsubscribe_topic, run)
        items = {
            client.submit(_build_one, run, item, str(root / item.name), options, key=f"{run}-{item.name}"): item
            for item in captures
        }
        try:
            for future in as_completed(items):
                yield _outcome(future, items[future])
        except BaseException:
            notify("stopping; finished stages are kept")
            client.run(_cancel, run, on_error="ignore")
            with contextlib.suppress(TimeoutError):
                wait(list(items), timeout=_STOP_SECONDS)
            raise


def _cancel(run: str) -> None:
    _cancelled.add(run)


def _outcome(future: Future[Outcome], item: ListedCapture) -> Outcome:
    if future.status == "finished":
        return future.result()
    error = future.exception() if future.status == "error" else None
    reason = f"{type(error).__name__}: {error}" if error else "the connection to the cluster was lost"
    if type(error).__name__ == "KilledWorker":
        reason = "every process that ran it died, perhaps because it ran out of memory"
    return Outcome(item.name, str(item.path), FAILED, error=reason)


def _build_one(run: str, item: ListedCapture, folder: str, options: BuildOptions) -> Outcome:
    """Build one capture; runs on a worker."""
    outcome = Outcome(item.name, str(item.path), FAILED)
    map_large_arrays()
    try:
        summary = build(item.path, folder, options, _progress(run, item.name))
    except _CancelledError:
        return replace(outcome, status=STOPPED)
    except JawusdError as error:
        return replace(outcome, error=str(error))
    except Exception as error:  # an unexpected error in one build must not stop the others
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}, line {place.lineno}"
        return replace(outcome, error=f"unexpected {type(error).__name__} in {where}: {error}")
    track, fit = summary["track"], summary["fit"]
    return replace(
        outcome,
        status=KEPT if set(summary["seconds"]) <= set(summary["reused"]) else BUILT,
        frames=track["frames"],
        tracked=track["tracked"],
        model_mm=_mean_mm(fit, "train"),
        holdout_mm=_mean_mm(fit, "holdout"),
        sigma_incisor_mm=track["sigma_mm"].get("incisor"),
        seconds=round(sum(summary["seconds"].values()), 1),
    )


def _mean_mm(fit: FitSummary, table: str) -> float | None:
    return fit.get("errors", {}).get(table, {}).get("mandible", {}).get("mean")


def _progress(run: str, name: str) -> Progress:
    """Return a progress callback for a build on a worker; it raises if the run was cancelled."""
    worker, stage_before, last = get_worker(), "", 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal stage_before, last
        if run in _cancelled:
            raise _CancelledError
        now = time.monotonic()
        if stage != stage_before or now - last > _NOTIFY_SECONDS:
            stage_before, last = stage, now
            worker.log_event(run, f"{name}: {stage} {done}/{total}" if total > 1 else f"{name}: {stage}")

    return report


class _IgnoreInterrupt(WorkerPlugin):
    """Ignore signals that a terminal or service sends to all processes; the parent process handles them.

    Otherwise the cluster would replace a worker ended by such a signal and continue the build.
    """

    def setup(self, worker: Worker) -> None:
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), signal.SIG_IGN)


@contextlib.contextmanager
def local_cluster(workers: int, retries: int) -> Iterator[Client]:
    """Run single-threaded worker processes on the loopback interface, and yield a client connected to them.

    A task is retried up to `retries` times after its worker died.
    """
    settings = {
        "distributed.scheduler.allowed-failures": retries,
        # Profiling takes 2 to 3 % of the time, and only a dashboard shows the profile.
        "distributed.worker.profile.enabled": False,
    }
    with (
        tempfile.TemporaryDirectory(prefix="jawusd-") as scratch,
        dask.config.set(settings | {"temporary-directory": scratch}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host=_LOOPBACK,
            # Port 0 means any free port; without an address, the dashboard server would require its default port.
            dashboard_address=f"{_LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
            memory_limit=0,  # no memory limit per worker
            silence_logs=logging.CRITICAL,
            local_directory=scratch,
        ) as cluster,
        Client(cluster) as client,
    ):
        client.register_plugin(_IgnoreInterrupt())
        yield client


@contextlib.contextmanager
def existing_cluster(address: str) -> Iterator[Client]:
    """Connect to a scheduler at an address such as "tcp://host:8786", and yield the client.

    Raises ClusterError if no scheduler answers, or if it has no workers.
    """
    try:
        asyncio.run(_greet(address))
    except (OSError, ValueError, TypeError, MemoryError) as error:
        raise ClusterError(
            f"no scheduler answers at {address} ({str(error) or 'connected, but no reply'}).",
            hint="Start one with: dask scheduler, and workers with: dask worker ADDRESS --nthreads 1",
        ) from error
    with silence_logging_cmgr(logging.CRITICAL), Client(address, timeout=CONNECT_SECONDS) as client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError as error:
            hint = "Start some with: dask worker ADDRESS --nthreads 1"
            raise ClusterError(f"the scheduler at {address} has no worker.", hint=hint) from error
        yield client


async def _greet(address: str) -> None:
    """Perform the handshake with a scheduler; a `Client` would wait forever for a server that does not answer."""
    arguments = Security().get_connection_args("client")
    async with asyncio.timeout(CONNECT_SECONDS + 1):
        comm = await connect(address, timeout=CONNECT_SECONDS, **arguments)
        await comm.close()


def check_workers(client: Client, folder: Path) -> None:
    """Raise ClusterError unless every worker runs this version of jawusd and can access the output folder."""
    for address, answer in client.run(_look, str(folder), on_error="return").items():
        if isinstance(answer, Exception):
            raise ClusterError(f"worker {address} cannot run jawusd ({type(answer).__name__}: {answer}).")
        version, sees_folder = answer
        if version != __version__:
            raise ClusterError(f"worker {address} runs jawusd {version}, but this process runs {__version__}.")
        if not sees_folder:
            hint = "Use a folder that all machines share under the same path."
            raise ClusterError(f"worker {address} cannot access {folder}.", hint=hint)


def _look(folder: str) -> tuple[str, bool]:
    return __version__, Path(folder).is_dir()
