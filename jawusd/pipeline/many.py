"""Many captures: one build each on worker processes or a Dask cluster, and one table of the outcomes."""

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
from distributed import (
    Client,
    Future,
    LocalCluster,
    Security,
    Worker,
    WorkerPlugin,
    as_completed,
    get_worker,
    wait,
)
from distributed.comm import connect
from distributed.utils import silence_logging_cmgr

from jawusd.base.errors import ClusterError, JawusdError
from jawusd.base.version import __version__
from jawusd.formats.atomic import write_csv_atomic, write_text_atomic
from jawusd.formats.capture_list import ListedCapture
from jawusd.pipeline.build import BuildOptions, FitSummary, build
from jawusd.pipeline.memory import map_large_arrays
from jawusd.pipeline.state import Progress, make_folder
from jawusd.pipeline.workspace import check_folder

SUMMARY_JSON, SUMMARY_CSV = "builds.json", "builds.csv"
BUILT, KEPT, FAILED, STOPPED = "built", "kept", "failed", "stopped"

#: Called with one line of text about every event.
Notify = Callable[[str], None]

_NOTIFY_SECONDS = 10.0  # between two lines about one stage of one capture
_STOP_SECONDS = 15.0  # that builds have to end by themselves
CONNECT_SECONDS = 10
_LOOPBACK = "127.0.0.1"

# Runs that were called off; a worker may serve several.
_called_off: set[str] = set()


class _CalledOffError(Exception):
    """End a build from within."""


@dataclass(frozen=True)
class ManyOptions:
    """Choose how to build many captures.

    Attributes:
        build: how to build each.
        cluster: address of a Dask scheduler; None: processes of this machine.
        workers: how many processes of this machine; None: one per core, but no more than captures.
        retries: how often a capture is given to another process when one died over it; a scheduler that is already
            there uses its own number.
    """

    build: BuildOptions
    cluster: str | None = None
    workers: int | None = None
    retries: int = 3


@dataclass(frozen=True)
class Outcome:
    """Hold the outcome of the build of one capture.

    Attributes:
        name: of its folder.
        capture: its path.
        status: "built", "kept" (nothing had changed since an earlier build), "failed" or "stopped".
        frames, tracked: how many, and how many of them with both arches.
        model_mm: mean over the frames of the largest distance of a mandible vertex from the model.
        holdout_mm: the same for frames that were left out of the fit.
        sigma_incisor_mm: expected error of tracking at the incisal point, median.
        seconds: that its stages took.
        error: why it failed.
    """

    name: str
    capture: str
    status: str
    frames: int | None = None
    tracked: int | None = None
    model_mm: float | None = None
    holdout_mm: float | None = None
    sigma_incisor_mm: float | None = None
    seconds: float | None = None
    error: str | None = None


def build_many(captures: Sequence[ListedCapture], root: Path, options: ManyOptions, notify: Notify) -> list[Outcome]:
    """Build the rig of every capture in a folder of its own; one that fails does not stop the rest.

    The table of outcomes is written to builds.json and builds.csv, also when the work is interrupted.

    Args:
        root: gets a folder for each, by its name; every worker must see it by the same path.

    Returns:
        The outcomes in the order of the captures.

    Raises:
        OutputError: the folder of a capture holds a build and neither resume nor fresh is asked for, or cannot be made.
        ClusterError: the cluster cannot be used.
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
            _write(root, outcomes)
    return outcomes


def outcome_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Return outcomes as a table for people."""
    width = max(len("capture"), *(len(o.name) for o in outcomes))
    lines = [f"{'capture':<{width}}  status   frames  tracked  model mm  holdout mm  incisor mm  seconds"]
    for o in outcomes:
        figures = [(o.frames, 6, "d"), (o.tracked, 7, "d"), (o.model_mm, 8, ".3f"), (o.holdout_mm, 10, ".3f")]
        figures += [(o.sigma_incisor_mm, 10, ".3f"), (o.seconds, 7, ".1f")]
        cells = "  ".join(f"{'-' if value is None else format(value, form):>{w}}" for value, w, form in figures)
        lines.append(f"{o.name:<{width}}  {o.status:<7}  {cells}")
    return lines + [line for o in outcomes if o.error for line in f"{o.name}: {o.error}".split("\n")]


def _run(
    client: Client, captures: Sequence[ListedCapture], root: Path, options: BuildOptions, notify: Notify
) -> Iterator[Outcome]:
    """Yield outcomes as builds end; when the caller is interrupted, end those under way."""
    run = uuid.uuid4().hex
    # A worker that takes over from one that died meets what that one had finished.
    options = options if options.fresh else replace(options, resume=True)
    with _listening(client, run, notify):
        items = {
            client.submit(_build_one, run, item, str(root / item.name), options, key=f"{run}-{item.name}"): item
            for item in captures
        }
        try:
            for future in as_completed(items):
                yield _outcome(future, items[future])
        except BaseException:
            notify("stopping; what is finished is kept")
            client.run(_call_off, run, on_error="ignore")
            with contextlib.suppress(TimeoutError):
                wait(list(items), timeout=_STOP_SECONDS)
            raise


@contextlib.contextmanager
def _listening(client: Client, run: str, notify: Notify) -> Iterator[None]:
    """Pass on the messages of the workers of a run."""
    client.subscribe_topic(run, lambda event: notify(event[1]))
    try:
        yield
    finally:
        client.unsubscribe_topic(run)


def _call_off(run: str) -> None:
    _called_off.add(run)


def _outcome(future: Future[Outcome], item: ListedCapture) -> Outcome:
    if future.status == "finished":
        return future.result()
    error = future.exception() if future.status == "error" else None
    reason = f"{type(error).__name__}: {error}" if error else "the cluster went away"
    if type(error).__name__ == "KilledWorker":
        reason = "every process that worked on it died; did the memory last?"
    return Outcome(item.name, str(item.path), FAILED, error=reason)


def _build_one(run: str, item: ListedCapture, folder: str, options: BuildOptions) -> Outcome:
    """Build one capture; runs on a worker."""
    outcome = Outcome(item.name, str(item.path), FAILED)
    map_large_arrays()
    try:
        summary = build(item.path, folder, options, _progress(run, item.name))
    except _CalledOffError:
        return replace(outcome, status=STOPPED)
    except JawusdError as error:
        return replace(outcome, error=str(error))
    except Exception as error:  # a fault in one build must not lose the others
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
    """Return a reporter for one build on a worker, which also ends the build of a run that was called off."""
    worker, stage_before, last = get_worker(), "", 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal stage_before, last
        if run in _called_off:
            raise _CalledOffError
        now = time.monotonic()
        if stage != stage_before or now - last > _NOTIFY_SECONDS:
            stage_before, last = stage, now
            worker.log_event(run, f"{name}: {stage} {done}/{total}" if total > 1 else f"{name}: {stage}")

    return report


def _write(root: Path, outcomes: Sequence[Outcome]) -> None:
    rows = [asdict(outcome) for outcome in outcomes]
    write_text_atomic(root / SUMMARY_JSON, json.dumps({"format": "jawusd-builds/1", "builds": rows}, indent=1) + "\n")
    write_csv_atomic(root / SUMMARY_CSV, [field.name for field in fields(Outcome)], rows)


class _IgnoreInterrupt(WorkerPlugin):
    """Leave signals that a terminal or a service sends to all processes to the one that started them.

    A worker that such a signal ended would be replaced, and the new one would go on with the build.
    """

    def setup(self, worker: Worker) -> None:
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), signal.SIG_IGN)


@contextlib.contextmanager
def local_cluster(workers: int, retries: int) -> Iterator[Client]:
    """Start worker processes of one thread each that listen to this machine alone, and yield a client of them.

    None is left when the block ends.

    Args:
        retries: how often work is given to another worker when one died over it.
    """
    settings = {
        "distributed.scheduler.allowed-failures": retries,
        # There is no dashboard to show it, and noting all stacks 100 times a second takes 2 to 3 % of the time.
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
            # No dashboard; without an address of its own the server for it would insist on one port.
            dashboard_address=f"{_LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
            memory_limit=0,  # what a build needs does not depend on the share of memory; the system limits it
            silence_logs=logging.CRITICAL,
            local_directory=scratch,
        ) as cluster,
        Client(cluster) as client,
    ):
        client.register_plugin(_IgnoreInterrupt())
        yield client


@contextlib.contextmanager
def existing_cluster(address: str) -> Iterator[Client]:
    """Connect to a scheduler at an address such as "tcp://host:8786", and yield a client of it.

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
