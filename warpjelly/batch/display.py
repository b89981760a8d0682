"""How a batch goes, for people: a live display on a terminal, plain lines elsewhere."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from ..errors import INTERRUPTED
from .jobs import Job, Result, Watcher
from .specs import COMPARISON_NAME, PAGE_NAME, TABLE_NAME

if TYPE_CHECKING:
    from .batch import Batch

# A summary names so many runs that failed.
FAILURES_SHOWN = 10


@contextmanager
def display(*, quiet: bool = False) -> Iterator[Watcher]:
    """Give what shows on stderr how a batch goes."""
    if quiet:
        yield Watcher()
    elif not sys.stderr.isatty():
        yield Lines()
    else:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            yield Live(progress)


class Lines(Watcher):
    """Writes a line for each run that has ended."""

    def __init__(self) -> None:
        self._done = self._failed = self._total = 0
        self._frames = self._all_frames = 0
        self._under_way: dict[str, int] = {}
        self._began = time.monotonic()

    def begin(self, jobs: Sequence[Job], done: int) -> None:
        """Take in what there is to do."""
        self._done, self._total = done, done + len(jobs)
        self._all_frames = sum(job.scene.frame_count for job in jobs)
        self._began = time.monotonic()
        if done:
            self.say(f"{len(jobs)} of {self._total} runs are to be done; the others are finished, or cannot begin")

    def advance(self, worker: str, job: Job, done: int) -> None:
        """Take in how far a run is."""
        # By its name, as another worker may go on with it.
        self._under_way[job.name] = done

    def end(self, worker: str, job: Job, result: Result) -> None:
        """Write what came of a run."""
        done = self._under_way.pop(job.name, 0)
        if result.exit_code == 0:
            self._frames += job.scene.frame_count
        else:
            # The frames that there will not be took no time, and need none.
            self._frames += done
            self._all_frames -= job.scene.frame_count - done
        self._done += 1
        self._failed += result.exit_code not in (0, INTERRUPTED)
        self.tell(job, result)

    def draw(self, done: int, total: int) -> None:
        """Write once that pictures are drawn, which takes a while."""
        if done == 1:
            self.say(f"drawing {total} runs")

    def tell(self, job: Job, result: Result) -> None:
        """Write a line about a run that has ended."""
        again = f", begun {result.attempts} times" if result.attempts > 1 else ""
        self.say(f"[{self._done}/{self._total}] {job.name}: {result.reason or 'finished'}{again}; {self.pace()}")

    def say(self, line: str) -> None:
        """Write a line."""
        print(line, file=sys.stderr, flush=True)

    @property
    def frames_done(self) -> int:
        """Number of frames of all runs that are done."""
        return self._frames + sum(self._under_way.values())

    def pace(self) -> str:
        """Say how fast it goes, and how long it will take from now on."""
        elapsed, done = time.monotonic() - self._began, self.frames_done
        if not done or elapsed <= 0.0:
            return "building"
        left = round(elapsed * (self._all_frames - done) / done)
        return f"{done / elapsed:,.0f} frames/s, {left // 60}:{left % 60:02} left"


class Live(Lines):
    """Shows the whole batch and what each worker is doing; writes lines for what goes wrong.

    Args:
        progress: where to show it; its columns take the field ``text``.
    """

    def __init__(self, progress: Progress) -> None:
        super().__init__()
        self._progress = progress
        self._whole = progress.add_task("batch", total=None, text="planning")
        self._rows: dict[str, TaskID] = {}

    def begin(self, jobs: Sequence[Job], done: int) -> None:
        """Show what there is to do."""
        super().begin(jobs, done)
        self._show()

    def advance(self, worker: str, job: Job, done: int) -> None:
        """Show how far a run is."""
        super().advance(worker, job, done)
        if worker not in self._rows:
            self._rows[worker] = self._progress.add_task("", total=None, text="")
        row, frames = self._rows[worker], job.scene.frame_count
        text = f"{done}/{frames} frames"
        self._progress.update(row, description=escape(job.name), total=frames, completed=done, text=text)
        self._show()

    def end(self, worker: str, job: Job, result: Result) -> None:
        """Show that a run has ended."""
        super().end(worker, job, result)
        if worker in self._rows:
            frames = job.scene.frame_count
            text = {0: "finished", INTERRUPTED: "interrupted"}.get(result.exit_code, "failed")
            self._progress.update(self._rows[worker], completed=frames, text=text)
        self._show()

    def draw(self, done: int, total: int) -> None:
        """Show how many pictures are drawn."""
        if done == 1:
            for row in self._rows.values():
                self._progress.remove_task(row)
            self._rows.clear()
        self._progress.update(self._whole, description="drawing", total=total, completed=done, text=f"{done}/{total}")

    def tell(self, job: Job, result: Result) -> None:
        """Write a line about a run that did not go well."""
        if result.exit_code != 0 or result.attempts > 1:
            super().tell(job, result)

    def say(self, line: str) -> None:
        """Write a line above what is shown."""
        self._progress.console.print(escape(line), highlight=False, soft_wrap=True)

    def _show(self) -> None:
        failed = f" ({self._failed} failed)" if self._failed else ""
        text = f"{self._done}/{self._total} runs{failed}, {self.pace()}"
        self._progress.update(self._whole, total=self._all_frames, completed=self.frames_done, text=text)


def list_runs(estimate: Mapping[str, Any]) -> None:
    """Print what a batch has to do; see ``estimate.estimate``."""
    runs = estimate["runs"]
    width = max(len(run["name"]) for run in runs)
    print(f"{'run':<{width}}  {'frames':>7} {'particles':>11} {'memory':>9} {'time':>9}  parameters")
    for run in runs:
        if run["problem"]:
            print(f"{run['name']:<{width}}  cannot begin: {run['problem']}")
            continue
        memory, seconds = f"{run['memory_bytes'] / 1e9:.2f} GB", f"{run['seconds']:.3g} s"
        given = ", ".join(f"{name} = {json.dumps(value)}" for name, value in run["parameters"].items())
        print(
            f"{run['name']:<{width}}  {run['frames']:>7,} {run['particles']:>11,} {memory:>9} {seconds:>9}  "
            f"{given or run['source']}"
        )
    print(
        f"{len(runs)} runs, {estimate['workers']} at a time: about {estimate['seconds']:.3g} s and "
        f"{estimate['memory_bytes'] / 1e9:.2f} GB of memory, besides what starting takes"
    )


def summarize(batch: Batch) -> None:
    """Print what came of a batch."""
    record, counts = batch.record, batch.record["counts"]
    told = [f"{counts[status]} {status}" for status in ("finished", "failed", "unfinished") if counts[status]]
    print(f"{counts['runs']} runs in {record['wall_seconds']:.1f} s: {', '.join(told)}")
    failed = [run for run in record["runs"] if run["status"] == "failed"]
    for run in failed[:FAILURES_SHOWN]:
        place = f"; log: {batch.folder / run['log']}" if run["log"] else ""
        print(f"  {run['name']}: {run['reason']}{place}")
    if len(failed) > FAILURES_SHOWN:
        print(f"  and {len(failed) - FAILURES_SHOWN} more")
    print(f"table: {batch.folder / TABLE_NAME}")
    page, comparison = batch.folder / PAGE_NAME, batch.folder / COMPARISON_NAME
    print(f"page:  {page} ({page.stat().st_size / 1e6:.1f} MB), for any browser")
    if comparison.is_file():
        print(f"stage: {comparison}, runs side by side")
