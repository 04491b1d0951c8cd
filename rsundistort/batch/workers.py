"""Where photos are worked on: threads of this process, or a Dask cluster."""

from __future__ import annotations

import os
import threading
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import cv2
import numba

from ..errors import InputError, RsUndistortWarning
from ..model.checks import check_whole
from .memory import free_memory

__all__ = ["Workers", "use_threads"]

T = TypeVar("T")
R = TypeVar("R")

# No machine has more cores, and each thread takes memory.
_MOST_JOBS = 4096
# Seconds that a scheduler has to answer.
_TIMEOUT_S = 10
# Share of the free memory that photos take together: what they need is an estimate.
_SHARE = 0.75
# How often Dask does a photo again whose function failed; that of a lost worker it gives to another by itself.
_RETRIES = 2


def use_threads(jobs: int) -> int:
    """Hold OpenCV and the kernels to a number of threads; 0 for all cores. Returns the number."""
    jobs = check_whole(jobs, "jobs", 0, _MOST_JOBS)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jobs = jobs or cores
    cv2.setNumThreads(jobs)
    numba.set_num_threads(min(jobs, numba.config.NUMBA_NUM_THREADS))
    return jobs


@dataclass(frozen=True)
class Workers:
    """Where photos are worked on.

    Attributes
    ----------
    jobs : int
        Threads of this process: decoding, remapping and encoding release Python's lock.
    scheduler : str or None
        Address of a Dask scheduler, whose workers do it instead. They see the same files under the same paths.
    threads_each : int
        Of OpenCV, in each of them.
    """

    jobs: int = 1
    scheduler: str | None = None
    threads_each: int = 1

    def fitting(self, what: str, bytes_each: float) -> Workers:
        """Only as many threads as have room in the memory that is free, but one at least; OpenCV gets what is left.

        Parameters
        ----------
        what : str
            What they do, for people: a warning says when there are fewer.
        bytes_each : float
            What the largest photo takes while it is worked on.
        """
        if self.scheduler is not None:  # its workers have memories, and limits, of their own
            return self
        free = free_memory()
        jobs = max(1, min(self.jobs, int(_SHARE * free / max(bytes_each, 1.0))))
        if jobs < self.jobs:
            need, left = (round(each / 2**30, 1) for each in (bytes_each, free))
            text = f"{what}: {jobs} of {self.jobs} photos at once; each may take {need} GB, and {left} GB are free"
            warnings.warn(text, RsUndistortWarning, stacklevel=2)
        return replace(self, jobs=jobs, threads_each=self.jobs // jobs)

    def map(
        self, function: Callable[[T], R], items: Iterable[T], lost: Callable[[T, str], R]
    ) -> Generator[R, None, None]:
        """Results in the order of the items, which are drawn a few ahead: memory does not grow with their number.

        Parameters
        ----------
        function : callable
            Of an item; with a scheduler it is pickled by name.
        items : iterable
            Drawn when they are due.
        lost : callable
            Result of an item, and why, that ended each of several Dask workers it was given to.

        To be closed: then what has not begun is dropped, and what has begun is waited for.
        """
        if self.scheduler is None:
            with _threads_each(self.threads_each), ThreadPoolExecutor(self.jobs) as pool:
                yield from _in_order(pool, function, items, 2 * self.jobs, (), lost)
        else:
            yield from _map_on_cluster(self.scheduler, function, items, lost)


def _in_order(
    pool: Executor,
    function: Callable[[T], R],
    items: Iterable[T],
    ahead: int,
    deadly: tuple[type[BaseException], ...],
    lost: Callable[[T, str], R],
) -> Iterator[R]:
    waiting: deque[tuple[T, Future[R]]] = deque()

    def first() -> R:
        item, future = waiting.popleft()
        try:
            return future.result()
        except deadly as error:
            return lost(item, f"it was lost with several workers of the cluster ({error})")

    try:
        for item in items:
            waiting.append((item, pool.submit(function, item)))
            if len(waiting) >= ahead:
                yield first()
        while waiting:
            yield first()
    finally:
        for _, future in waiting:
            future.cancel()


@contextmanager
def _threads_each(count: int) -> Iterator[None]:
    """OpenCV with one thread, where photos side by side take all cores already, or a few."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _map_on_cluster(
    address: str, function: Callable[[T], R], items: Iterable[T], lost: Callable[[T, str], R]
) -> Iterator[R]:
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise InputError('--scheduler needs Dask; install it: pip install "rsundistort[dask]"') from error
    try:
        client = Client(address, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"no Dask scheduler answers at {address}; give it as tcp://host:8786") from error
    with client, client.get_executor(pure=False, retries=_RETRIES) as pool:
        ahead = max(64, 4 * sum(client.nthreads().values()))
        work = partial(_on_worker, function)
        for result, said in _in_order(
            pool, work, items, ahead, (KilledWorker,), lambda item, why: (lost(item, why), [])
        ):
            for warning in said:
                warnings.warn(warning, stacklevel=3)
            yield result


def _on_worker(function: Callable[[T], R], item: T) -> tuple[R, list[Warning]]:
    """A function as a Dask worker calls it: OpenCV is held to its thread, and warnings come back with the result."""
    cv2.setNumThreads(1)
    with _caught_warnings() as said:
        return function(item), said


_caught = threading.local()
_catching = threading.Lock()


@contextmanager
def _caught_warnings() -> Iterator[list[Warning]]:
    """Our warnings in this thread; `warnings.catch_warnings` does not distinguish threads."""
    with _catching:
        if not isinstance(warnings.showwarning, _Catcher):
            warnings.simplefilter("always", RsUndistortWarning)
            warnings.showwarning = _Catcher(warnings.showwarning)
    said: list[Warning] = []
    _caught.list = said
    try:
        yield said
    finally:
        del _caught.list


@dataclass(frozen=True)
class _Catcher:
    """A `warnings.showwarning` that keeps ours where `_caught_warnings` is at work, and passes on all others."""

    others: Callable[..., None]

    def __call__(self, message: Warning | str, category: type[Warning], *args: Any, **kwargs: Any) -> None:
        said: list[Warning] | None = getattr(_caught, "list", None)
        if said is not None and isinstance(message, RsUndistortWarning):
            said.append(message)
        else:
            self.others(message, category, *args, **kwargs)
