"""Damaged files of every format: read, or refused in one line; soon, in memory that follows the file, and in OUT."""

from __future__ import annotations

import json
import os
import queue
import secrets
import shutil
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

if not Path("/proc/self/clear_refs").exists():
    pytest.skip("the most memory that was held is known on Linux alone", allow_module_level=True)
pytest.importorskip("av")
pytest.importorskip("pillow_heif")
pytest.importorskip("pyopf")

import groups
import hypothesis
from other_groups import OTHER_GROUPS, other_wholes

GROUPS = groups.GROUPS | OTHER_GROUPS
WHOLES = groups.wholes() | other_wholes()

SECONDS = 10.0
MEMORY, TIMES = 500 << 20, 20
# all of `make fuzz`; a small share of it in `make test`, always the same
COUNT = int(os.environ.get("RSUNDISTORT_FUZZ", "0"))
# where inputs that failed are kept
KEPT = Path(os.environ["RSUNDISTORT_FUZZ_KEPT"]) if "RSUNDISTORT_FUZZ_KEPT" in os.environ else None
SEED = int(os.environ.get("RSUNDISTORT_FUZZ_SEED", "0")) or (secrets.randbelow(2**32) if COUNT else 0)


def _listen(stream: Iterator[str], lines: queue.Queue[str]) -> None:
    """Lines of a stream, and an empty one at its end."""
    with suppress(ValueError):  # closed meanwhile
        for line in stream:
            lines.put(line)
    lines.put("")


class Child:
    """The process that reads; another one after it hung or died."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: subprocess.Popen[str] | None = None
        self.counts: Counter[tuple[str, str]] = Counter()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("child.py"))],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=self.folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"},
        )  # fmt: skip
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=_listen, args=(self._process.stdout, self._lines), daemon=True).start()
        assert self._lines.get(timeout=300).strip() == "ready"

    def ask(self, group: str, folder: Path) -> dict[str, object]:
        if self._process is None:
            self._start()
        try:
            self._process.stdin.write(json.dumps({"group": group, "folder": str(folder)}) + "\n")
            self._process.stdin.flush()
            line = self._lines.get(timeout=SECONDS)
        except queue.Empty:
            self.stop()
            return {"became": "failed", "said": f"hangs for {SECONDS:g} s"}
        if not line:
            self.stop()
            return {"became": "failed", "said": "the process died"}
        return json.loads(line)

    def stop(self) -> None:
        if self._process is not None:
            with self._process:  # which closes its streams
                self._process.kill()
            self._process = None


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    made = Child(tmp_path_factory.mktemp("child"))
    yield made
    made.stop()
    print(f"\nfuzz: seed {SEED}")
    for name in dict.fromkeys(name for name, _ in made.counts):
        print(f"| {name} | {made.counts[name, 'read']} | {made.counts[name, 'refused']} |")


def lay_out(files: dict[str, bytes], folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)


def judged(child: Child, name: str, files: dict[str, bytes], work: Path) -> dict[str, object]:
    """What became of an input; what must not be is an error that says which input it was."""
    group = GROUPS[name]
    folder = work / "input"
    every = {**group.beside(), **files}
    lay_out(every, folder)
    outside = {path for path in work.parent.rglob("*") if folder not in path.parents}
    became = child.ask(group.reader, folder)
    size = sum(map(len, every.values()))
    if became["became"] != "failed" and became["bytes"] > MEMORY + TIMES * size:
        became |= {"became": "failed", "said": f"took {became['bytes'] >> 20} MB for {size} bytes"}
    assert {path for path in work.parent.rglob("*") if folder not in path.parents} == outside
    moved = group.reader in ("report", "record")  # these read what lies in OUT, or under another name
    assert moved or all((folder / path).read_bytes() == data for path, data in every.items())
    return became


@pytest.mark.parametrize(
    ("name", "number"), [(name, number) for name, files in WHOLES.items() for number in range(len(files))]
)
def test_files_that_are_not_damaged(child, tmp_path, name, number):
    (tmp_path / "work").mkdir()
    assert judged(child, name, WHOLES[name][number], tmp_path / "work")["said"] == ""


@pytest.mark.timeout(3600 if COUNT else 400)
@pytest.mark.parametrize("name", GROUPS)
def test_damaged_files(child, tmp_path, name):
    num = -(-COUNT * GROUPS[name].share // sum(each.share for each in GROUPS.values())) if COUNT else 12
    work = tmp_path / "work"
    work.mkdir()

    failures: dict[str, str] = {}

    # one failure does not end the others; an input that hangs would take ten seconds for each smaller one
    @hypothesis.settings(
        max_examples=num, deadline=None, database=None, derandomize=not COUNT, phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    @hypothesis.given(GROUPS[name].made())
    def tried(files):
        became = judged(child, name, files, work)
        child.counts[name, str(became["became"])] += 1
        said = str(became["said"])
        if became["became"] == "failed" and said.splitlines()[-1] not in failures:
            kept = (
                KEPT / f"{name.replace(' ', '-')}-{len(failures)}" if KEPT else work.parent / f"failed-{len(failures)}"
            )
            lay_out({**GROUPS[name].beside(), **files}, kept)
            failures[said.splitlines()[-1]] = f"{kept}: {said}"

    (hypothesis.seed(SEED)(tried) if COUNT else tried)()
    assert not failures, "\n\n".join(failures.values())
