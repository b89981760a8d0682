"""Batches: results like those of single runs, whatever happens to workers, to the batch itself or to other runs."""

from __future__ import annotations

import csv
import io
import json
import os
import queue
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from runs import CUBE, samples_of

import warpjelly as wj
from warpjelly.batch import ledger, pool
from warpjelly.batch.batch import BatchInterruptedError, RunsFailedError, estimate_batch, run_batch
from warpjelly.batch.cluster import RayEngine
from warpjelly.batch.display import Live
from warpjelly.batch.jobs import Job, Result, Watcher
from warpjelly.batch.perform import perform
from warpjelly.batch.pool import LocalEngine
from warpjelly.batch.sweep import Sweep
from warpjelly.errors import INTERRUPTED, EnvironmentFailedError, InputError, verdict
from warpjelly.machine import available_cores
from warpjelly.scenefile import load_scene
from warpjelly.stage.validate import stage_problems

STIFFNESS = "materials.jelly.structural.stiffness"
SMALL = {"bodies.cube.particles_per_edge": 3, "frames": 10, "bodies.cube.position": [0.0, 1.1, 0.0]}
# Long enough that there is time to disturb it, and to interrupt it.
LONG = {**SMALL, "frames": 400}
# A process of its own may be late on a machine that others use.
PATIENCE = 60.0


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    """Return the scene of these batches: that of the jello cube, which has no frames of its own."""
    path = tmp_path_factory.mktemp("base") / "cube.toml"
    path.write_text(re.sub(r"(?m)^duration = .*$", "", CUBE.read_text()))
    return path


def make_sweep(base: Path, values: list[float], **settings: Any) -> Sweep:
    """Return a sweep over stiffness."""
    return Sweep(base=base, name="k{k}", vary={"k": {"keys": [STIFFNESS], "values": values}}, set=settings or SMALL)


def write_sweep(folder: Path, base: Path, values: list[Any], settings: dict[str, Any], key: str = STIFFNESS) -> Path:
    """Write the same as a file."""
    path = folder / "sweep.toml"
    told = "".join(f'"{name}" = {json.dumps(value)}\n' for name, value in settings.items())
    vary = f'[vary.k]\nkeys = ["{key}"]\nvalues = {json.dumps(values)}\n'
    path.write_text(f"base = '{base}'\nname = 'k{{k}}'\n[set]\n{told}{vary}")
    return path


class Here:
    """An engine that does jobs in this process."""

    name = "here"
    workers = 1

    def __enter__(self) -> Here:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def run(self, jobs: Sequence[Job], *, watcher: Watcher, stopping: Callable[[], bool]) -> Iterator[Result]:
        """Do one job after another."""
        return (perform(job, device="cpu") for job in jobs)


@dataclass
class Cli:
    """A batch in a process of its own."""

    process: subprocess.Popen[str]
    folder: Path

    def end(self) -> tuple[int, str, str]:
        """Return exit code, stdout and stderr."""
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err

    def record(self) -> dict[str, Any]:
        """Return the contents of batch.json."""
        return json.loads((self.folder / "batch.json").read_text())

    def wait_for(self, found: Callable[[], Any]) -> Any:
        """Return what a function finds, as soon as it is something."""
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            if something := found():
                return something
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.002)
        raise TimeoutError

    def writer_of(self, name: str, frames: int = 3) -> Callable[[], int | None]:
        """Return a function that finds the process that writes a run of some frames at least."""

        def find() -> int | None:
            try:
                if (self.folder / name / "metrics.csv").read_bytes().count(b"\n") > frames:
                    return int((self.folder / name / "run.lock").read_text())
            except (OSError, ValueError):
                pass
            return None

        return find

    def finished(self) -> list[Path]:
        """Return the records of the runs that are finished."""
        return sorted(self.folder.glob("*/run.json"))


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a batch."""
    started = []

    def start(sweep: Path, *options: object, limit: int | None = None) -> Cli:
        folder = tmp_path / "out"

        def bound() -> None:
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

        told = ["-o", folder, "--device=cpu", "--no-pictures", *options]
        command = [sys.executable, "-m", "warpjelly.cli", "batch", sweep, *told]
        pipe = subprocess.PIPE
        one_thread = dict.fromkeys(pool._THREADS, "1")
        process = subprocess.Popen(
            list(map(str, command)),
            stdout=pipe,
            stderr=pipe,
            text=True,
            env={**os.environ, **one_thread},
            preexec_fn=bound,
        )
        started.append(process)
        return Cli(process, folder)

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
            process.communicate()


def is_alive(process: int) -> bool:
    """Say whether a process is running, and not just waiting to be buried."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def assert_whole(folder: Path, base: Path, values: list[float], settings: dict[str, Any], tmp_path: Path) -> None:
    """Hold the runs of a batch against single runs of the same scenes, to the bit."""
    for value in values:
        alone = tmp_path / f"alone{value}"
        wj.simulate(load_scene(base, overrides={**settings, STIFFNESS: value}), output=alone, device="cpu")
        run = folder / f"k{value}"
        assert stage_problems(run) == []
        assert samples_of(run) == samples_of(alone)
        assert (run / "metrics.csv").read_bytes() == (alone / "metrics.csv").read_bytes()


def test_runs_are_those_of_warpjelly_run_and_the_records_tell_of_them(base, tmp_path):
    """Compare a small batch with single runs, its record with theirs, and the table with the record."""
    values = [50, 100, 200]
    batch = run_batch(make_sweep(base, values), output=tmp_path / "out", device="cpu", workers=2)
    assert_whole(tmp_path / "out", base, values, SMALL, tmp_path)
    record = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert record == batch.record
    assert record["counts"] == {"runs": 3, "finished": 3, "failed": 0, "unfinished": 0}
    assert record["workers"] == 2
    with open(tmp_path / "out" / "batch.csv", newline="") as file:
        table = list(csv.DictReader(file))
    for value, run, row in zip(values, record["runs"], table, strict=True):
        own = json.loads((tmp_path / "out" / f"k{value}" / "run.json").read_text())
        assert run["name"] == row["name"] == f"k{value}"
        assert run["parameters"] == {"k": value}
        assert (run["status"], run["reason"], run["exit_code"], run["attempts"]) == ("finished", None, 0, 1)
        assert (tmp_path / "out" / run["stage"]).is_file()
        assert "finished after" in (tmp_path / "out" / run["log"]).read_text()
        assert run["scene_hash"] == own["scene_hash"]
        assert run["expect"] == own["expect"]
        figures = {outcome["quantity"]: outcome["value"] for outcome in own["expect"]}
        figures |= {name: own[name] for name in ("frames", "particles", "springs", "wall_seconds")}
        with open(tmp_path / "out" / f"k{value}" / "metrics.csv", newline="") as file:
            metrics = list(csv.DictReader(file))
        figures |= {"max_speed": max(float(frame["max_speed"]) for frame in metrics)}
        figures |= {"spring_losses": float(metrics[-1]["spring_losses"])}
        assert run["figures"].items() >= figures.items()
        assert float(row["bounce"]) == run["figures"]["bounce"]
        assert (int(row["k"]), row["stage"], row["status"]) == (value, run["stage"], "finished")


def test_a_run_that_diverges_or_has_bad_input_leaves_the_others_alone(base, tmp_path, start):
    """Have one run blow up, and one scene refused; the others finish, exit code 3, and reasons and log are named."""
    sweep = write_sweep(tmp_path, base, [100, 1e9, -1, 50], SMALL)
    cli = start(sweep, "--json")
    code, out, err = cli.end()
    assert code == 3
    record = json.loads(out)
    assert record == cli.record()
    assert record["counts"] == {"runs": 4, "finished": 2, "failed": 2, "unfinished": 0}
    _, diverged, refused, _ = record["runs"]
    assert (diverged["exit_code"], diverged["attempts"]) == (3, 1)
    assert "the simulation diverged" in diverged["reason"]
    assert "the simulation diverged" in (cli.folder / diverged["log"]).read_text()
    assert (refused["exit_code"], refused["log"], refused["stage"]) == (2, None, None)
    assert refused["reason"] == f"{sweep}: {base}: {STIFFNESS} = -1: must be greater than or equal to 0 " + (
        "(N with law strain, N/m with law hooke)"
    )
    *lines, last = err.splitlines()
    assert last == f"error: 2 of 4 runs failed; {cli.folder / 'batch.csv'} says why"
    assert sum("finished" in line and re.match(r"\[\d/4\] k", line) is not None for line in lines) == 2
    assert not any("\x1b" in line for line in lines)


def test_a_killed_worker_costs_its_run_a_second_attempt(base, tmp_path, start):
    """Kill a worker in the middle of a run: the run goes on in another process, to the same bits."""
    values = [50, 100, 150]
    cli = start(write_sweep(tmp_path, base, values, LONG), "--workers=2")
    os.kill(cli.wait_for(cli.writer_of("k50", frames=30)), signal.SIGKILL)
    code, _, err = cli.end()
    assert code == 0, err
    runs = {run["name"]: run for run in cli.record()["runs"]}
    assert {name: run["attempts"] for name, run in runs.items()} == {"k50": 2, "k100": 1, "k150": 1}
    assert "k50: finished, begun 2 times" in err
    assert "going on" in (cli.folder / "k50" / "run.log").read_text()
    assert_whole(cli.folder, base, values, LONG, tmp_path)


def test_a_run_whose_process_is_lost_twice_has_failed(base, tmp_path, start):
    """Kill the worker of a run, and the next one, too; the others finish, and --resume does the one that is missing."""
    sweep = write_sweep(tmp_path, base, [50, 100], LONG)
    cli = start(sweep, "--workers=1")
    first = cli.wait_for(cli.writer_of("k50"))
    os.kill(first, signal.SIGKILL)
    second = cli.wait_for(lambda: (found := cli.writer_of("k50")()) != first and found)
    os.kill(second, signal.SIGKILL)
    code, out, _ = cli.end()
    assert code == 3
    killed, other = cli.record()["runs"]
    assert (
        killed["reason"]
        == "its process was killed by SIGKILL, as the system does when memory runs out, 2 times in a row"
    )
    assert (killed["status"], killed["exit_code"], other["status"]) == ("failed", 4, "finished")
    assert f"k50: {killed['reason']}; log: {cli.folder / 'k50' / 'run.log'}" in out
    kept = (cli.folder / "k100" / "stage.usdc").stat().st_mtime_ns
    cli = start(sweep, "--resume")
    assert cli.end()[0] == 0
    killed, other = cli.record()["runs"]
    assert (killed["status"], killed["attempts"], other["status"], other["attempts"]) == ("finished", 1, "finished", 0)
    assert (cli.folder / "k100" / "stage.usdc").stat().st_mtime_ns == kept
    assert_whole(cli.folder, base, [50, 100], LONG, tmp_path)


def test_a_killed_batch_keeps_what_is_finished_and_goes_on(base, tmp_path, start):
    """Kill the parent: its workers end by themselves, and --resume does only what is missing, from where it was."""
    values = [50, 100, 150, 200]
    sweep = write_sweep(tmp_path, base, values, LONG)
    cli = start(sweep, "--workers=2")
    cli.wait_for(cli.finished)
    busy = cli.wait_for(lambda: [pid for value in values if (pid := cli.writer_of(f"k{value}", 30)())])
    # Held until the parent is gone, or they might have finished by then.
    for pid in busy:
        os.kill(pid, signal.SIGSTOP)
    cli.process.kill()
    cli.process.wait()
    for pid in busy:
        os.kill(pid, signal.SIGCONT)
    cli.process.communicate()
    until = time.monotonic() + PATIENCE
    while any(map(is_alive, busy)) and time.monotonic() < until:
        time.sleep(0.01)
    assert not any(map(is_alive, busy))
    kept = {record.parent.name: (record.parent / "stage.usdc").stat().st_mtime_ns for record in cli.finished()}
    assert 1 <= len(kept) < len(values)
    cli = start(sweep, "--resume")
    code, _, err = cli.end()
    assert code == 0, err
    assert {name: (cli.folder / name / "stage.usdc").stat().st_mtime_ns for name in kept} == kept
    for run in cli.record()["runs"]:
        assert (run["status"], run["attempts"]) == ("finished", 0 if run["name"] in kept else 1)
    logs = [(cli.folder / f"k{value}" / "run.log").read_text() for value in values]
    assert any("going on" in log for log in logs)
    assert_whole(cli.folder, base, values, LONG, tmp_path)


def test_ctrl_c_ends_runs_after_their_frame_and_resume_goes_on(base, tmp_path, start):
    """Interrupt a batch, find it said and nothing lost, and end it with --resume, to the bits of single runs."""
    values = [50, 100, 150]
    sweep = write_sweep(tmp_path, base, values, LONG)
    cli = start(sweep, "--workers=2")
    cli.wait_for(cli.writer_of("k50", frames=30))
    cli.process.send_signal(signal.SIGINT)
    code, out, err = cli.end()
    assert code == 130
    record = cli.record()
    counts = record["counts"]
    assert err.splitlines()[-1] == (
        f"error: interrupted: {counts['finished']} of 3 runs are finished, in {cli.folder}; go on with --resume"
    )
    assert counts["unfinished"] >= 1
    assert counts["failed"] == 0
    assert "unfinished" in out
    begun = record["runs"][0]
    assert (begun["status"], begun["exit_code"]) == ("unfinished", 130)
    assert re.match(r"interrupted after \d+ of 400 frames", begun["reason"])
    cli = start(sweep, "--resume")
    assert cli.end()[0] == 0
    assert "going on" in (cli.folder / "k50" / "run.log").read_text()
    assert_whole(cli.folder, base, values, LONG, tmp_path)


def test_a_second_ctrl_c_ends_runs_at_once(base, tmp_path, start):
    """Interrupt a batch twice whose run does not get to the end of its frame."""
    cli = start(write_sweep(tmp_path, base, [50, 100], LONG), "--workers=1")
    worker = cli.wait_for(cli.writer_of("k50"))
    os.kill(worker, signal.SIGSTOP)
    cli.process.send_signal(signal.SIGINT)
    # One that is not heard yet would be the same one.
    time.sleep(1.0)
    cli.process.send_signal(signal.SIGINT)
    code, _, err = cli.end()
    assert (code, err.splitlines()[-1]) == (130, "error: interrupted")
    assert not is_alive(worker)
    assert cli.record()["counts"] == {"runs": 2, "finished": 0, "failed": 0, "unfinished": 2}


def test_ctrl_c_while_runs_are_drawn_leaves_a_page_without_pictures(base, tmp_path, monkeypatch):
    """Interrupt what draws."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("warpjelly.previews.thumbnails.draw_thumbnails", interrupted)
    with pytest.raises(BatchInterruptedError, match="interrupted: 1 of 1 runs are finished"):
        run_batch(make_sweep(base, [50]), output=tmp_path / "out", engine=Here(), pictures=True)
    assert "The runs were not drawn" in (tmp_path / "out" / "index.html").read_text()


def test_a_run_that_exhausts_memory_leaves_the_others_alone(base, tmp_path, start):
    """Limit memory to what a small run needs and some more, and ask for a body that needs far more than that."""
    probe = (
        "import warpjelly as wj, sys, re;"
        f"s = wj.load_scene({str(base)!r}, overrides={SMALL!r});"
        f"wj.simulate(s, output={str(tmp_path / 'probe')!r}, device='cpu');"
        "print(re.search(r'VmPeak:\\s+(\\d+)', open('/proc/self/status').read())[1])"
    )
    env = {**os.environ, **dict.fromkeys(pool._THREADS, "1")}
    needed = int(subprocess.run([sys.executable, "-c", probe], env=env, capture_output=True, check=True).stdout) * 1024
    limit = needed + 250_000_000
    # A cube of 240^3 particles needs 1 GB and more.
    key = "bodies.cube.particles_per_edge"
    settings = {name: value for name, value in SMALL.items() if name != key}
    sweep = write_sweep(tmp_path, base, [3, 240, 4], settings, key)
    cli = start(sweep, "--workers=1", limit=limit)
    code, _, err = cli.end()
    assert code == 3, err
    runs = {run["name"]: run for run in cli.record()["runs"]}
    assert {name: run["status"] for name, run in runs.items()} == {"k3": "finished", "k240": "failed", "k4": "finished"}
    assert runs["k240"]["exit_code"] == 4
    assert re.search("out of memory|its process was killed", runs["k240"]["reason"])
    assert (cli.folder / runs["k240"]["log"]).read_text()


def test_an_array_that_warp_has_no_memory_for_is_out_of_memory():
    """Ask Warp for more than any machine has, and read what people are told."""
    with pytest.raises(RuntimeError) as error:
        wp.empty((2**30, 2**20), dtype=wp.float64, device="cpu")
    assert verdict(error.value) == ("out of memory; lower the resolution or the particles per edge", 4)


def test_two_batches_do_not_share_a_folder(base, tmp_path, start):
    """Try a second batch while one is going: it is refused, and the first one goes on."""
    sweep = write_sweep(tmp_path, base, [50, 100], {**SMALL, "frames": 100_000})
    first = start(sweep)
    first.wait_for(first.writer_of("k50"))
    writing = rf"{first.folder}: process {first.process.pid} is writing into this folder"
    for options in ({}, {"force": True}, {"resume": True}):
        with pytest.raises(InputError, match=writing):
            run_batch(sweep, output=first.folder, device="cpu", **options)
    written = (first.folder / "k50" / "metrics.csv").stat().st_size
    first.wait_for(lambda: (first.folder / "k50" / "metrics.csv").stat().st_size > written)


def test_finished_runs_are_known_by_what_they_simulate(base, tmp_path):
    """Resume with other names, more frames and other values: only what differs is done."""
    folder = tmp_path / "out"
    run_batch(make_sweep(base, [50, 100]), output=folder, engine=Here())
    before = samples_of(folder / "k50")
    with pytest.raises(InputError, match=r"out: holds a batch already \(batch.json\); go on with --resume, replace"):
        run_batch(make_sweep(base, [50, 100]), output=folder, engine=Here())
    renamed = make_sweep(base, [50, 100, 150]).model_copy(update={"name": "stiffness{k}"})
    batch = run_batch(renamed, output=folder, engine=Here(), resume=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [0, 0, 1]
    assert samples_of(folder / "stiffness50") == before
    assert {path.name for path in folder.iterdir() if path.is_dir()} == {"stiffness50", "stiffness100", "stiffness150"}
    record = json.loads((folder / "stiffness50" / "run.json").read_text())
    assert (record["run_dir"], record["stage"]) == (str(folder / "stiffness50"), str(folder / "stiffness50/stage.usdc"))
    # More frames go on from where the runs ended.
    longer = renamed.model_copy(update={"set": {**SMALL, "frames": 15}})
    batch = run_batch(longer, output=folder, engine=Here(), resume=True)
    assert [run["figures"]["frames"] for run in batch.record["runs"]] == [15, 15, 15]
    assert "going on" in (folder / "stiffness50" / "run.log").read_text()
    # Another scene under the same names is not what was finished, which nobody said to replace.
    other = longer.model_copy(update={"set": {**longer.set, "gravity": [0.0, -5.0, 0.0]}})
    with pytest.raises(InputError, match=r"stiffness50: holds a finished run of another scene .* \(and 2 more do\)"):
        run_batch(other, output=folder, engine=Here(), resume=True)
    batch = run_batch(other, output=folder, engine=Here(), resume=True, force=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [1, 1, 1]
    batch = run_batch(other, output=folder, engine=Here(), resume=True, force=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [0, 0, 0]
    batch = run_batch(other, output=folder, engine=Here(), force=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [1, 1, 1]


@pytest.mark.parametrize("values", [[40, 50, 60, 70], [70, 50], [60, 50, 70, 40]])
def test_finished_runs_are_known_where_names_have_changed_places(base, tmp_path, values):
    """Number the runs, and resume with a value before the old ones, in another order, and fewer: none is done twice."""
    folder = tmp_path / "out"

    def numbered(values: list[float]) -> Sweep:
        return make_sweep(base, values).model_copy(update={"name": "{number}"})

    run_batch(numbered([50, 60, 70]), output=folder, engine=Here())
    before = {value: samples_of(folder / str(number)) for number, value in enumerate((50, 60, 70), 1)}
    batch = run_batch(numbered(values), output=folder, engine=Here(), resume=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [int(value not in before) for value in values]
    for run, value in zip(batch.record["runs"], values, strict=True):
        assert run["scene_hash"] == json.loads((folder / run["name"] / "run.json").read_text())["scene_hash"]
        assert value not in before or samples_of(folder / run["name"]) == before[value]
    # Those that are not asked for are still there.
    assert len(list(folder.glob("*/stage.usdc"))) == len({50, 60, 70, *values})
    # One for which there is no place any more is only replaced if that is asked for.
    fewer = numbered([30, *values[:-1]])
    with pytest.raises(InputError, match="holds a finished run of another scene"):
        run_batch(fewer, output=folder, engine=Here(), resume=True)
    batch = run_batch(fewer, output=folder, engine=Here(), resume=True, force=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [1, *[0] * len(values[:-1])]


@given(
    there=st.lists(st.sampled_from("ABCD?"), max_size=5),
    wanted=st.lists(st.sampled_from("ABCDE"), max_size=5),
)
def test_folders_change_places_without_losing_any(there, wanted):
    """Have folders with finished and other contents, and ask for some under any names: all are kept, and each found."""
    with tempfile.TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patch:
        folder = Path(place)
        for number, content in enumerate(there):
            (folder / str(number)).mkdir()
            (folder / str(number) / "run.json").write_text(f'"{content}"')

        def content_of(path: Path) -> str:
            return json.loads((path / "run.json").read_text())

        patch.setattr(ledger, "_finished", lambda path: content if (content := content_of(path)) != "?" else None)
        hashes = {str(number): content for number, content in enumerate(wanted)}
        finished, places = ledger._find_finished(folder, hashes)
        ledger._move(folder, places)
        found = {path.name: content_of(path) for path in folder.iterdir()}
        assert sorted(found.values()) == sorted(there)
        assert {name for name, content in hashes.items() if found.get(name) == content} == finished
        # As many of each scene as there are, or as are asked for, which of equal ones is left to chance.
        for content in set(wanted):
            assert sum(hashes[name] == content for name in finished) >= (content in there)


def test_what_is_not_whole_is_done_again_and_what_is_no_run_is_left_alone(base, tmp_path):
    """Take stage, metrics or record from finished runs, and have a folder of something else; the others stay."""
    folder = tmp_path / "out"
    values = [50, 60, 70]
    run_batch(make_sweep(base, values), output=folder, engine=Here())
    (folder / "k50" / "stage.usdc").unlink()
    (folder / "k60" / "metrics.csv").unlink()
    for number, text in enumerate(("{}", "[]", "3", "nothing")):
        (folder / f"else{number}").mkdir()
        (folder / f"else{number}" / "run.json").write_text(text)
    batch = run_batch(make_sweep(base, values), output=folder, engine=Here(), resume=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [1, 1, 0]
    assert all((folder / run["stage"]).is_file() for run in batch.record["runs"])
    (folder / "k50" / "run.json").write_text("[]")
    with pytest.raises(InputError, match=r"out/k50: holds a finished run of another scene or version, or one that can"):
        run_batch(make_sweep(base, values), output=folder, engine=Here(), resume=True)
    batch = run_batch(make_sweep(base, values), output=folder, engine=Here(), resume=True, force=True)
    assert [run["attempts"] for run in batch.record["runs"]] == [1, 0, 0]
    assert (folder / "else1" / "run.json").read_text() == "[]"


@pytest.mark.parametrize("name", ["index.html", "batch.csv", "comparison.usda"])
def test_files_of_others_are_not_replaced(base, tmp_path, name):
    """Have a file in the folder that a batch would write, of something else."""
    (tmp_path / name).write_text("mine")
    for resume in (False, True):
        with pytest.raises(InputError, match=f"{name}: not of a batch, and a batch would replace it; choose another"):
            run_batch(make_sweep(base, [50]), output=tmp_path, engine=Here(), resume=resume)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_a_run_that_diverged_is_done_again_and_fails_again(base, tmp_path):
    """Resume a batch with a run that diverged."""
    sweep = make_sweep(base, [100, 1e9])
    for resume, attempts in ((False, [1, 1]), (True, [0, 1])):
        with pytest.raises(RunsFailedError, match="1 of 2 runs failed") as error:
            run_batch(sweep, output=tmp_path / "out", engine=Here(), resume=resume)
        assert [run["attempts"] for run in error.value.batch.record["runs"]] == attempts
        assert [run["status"] for run in error.value.batch.record["runs"]] == ["finished", "failed"]


class Idle:
    """A worker that never does anything; what it would be told is noted."""

    def __init__(self, name: str, device: str, threads: int, inbox: queue.SimpleQueue[Any]) -> None:
        self.name, self.inbox = name, inbox
        self.attempt, self.leaving, self.gone = None, False, False

    def begin(self, attempt: Any) -> None:
        """Take a job."""
        self.attempt = attempt

    def end(self, crew: Any) -> None:
        """End the job well, and have that heard."""
        self.inbox.put((self, Result(self.attempt.job.name, 0, None)))
        assert len(list(crew.listen(Watcher()))) == 1


def make_crew(monkeypatch: pytest.MonkeyPatch, base: Path, sizes: list[float]) -> tuple[Any, Callable[[], list[Any]]]:
    """Return three idle workers with jobs of so many bytes, and a function that says which they have."""
    monkeypatch.setattr(pool, "_Worker", Idle)
    crew = pool._Crew(["cpu"], 3)
    scene = load_scene(base, overrides=SMALL)
    crew.take([Job(str(number), scene, Path(str(number)), int(size)) for number, size in enumerate(sizes)])

    def under_way() -> list[Any]:
        crew.give_out()
        return [worker.attempt and worker.attempt.job.name for worker in crew._workers]

    return crew, under_way


def test_the_first_run_is_alone_until_it_has_a_frame(base, monkeypatch):
    """Give out three jobs: the first one compiles what is not compiled yet, the others follow."""
    crew, under_way = make_crew(monkeypatch, base, [1, 1, 1])
    assert under_way() == ["0", None, None]
    assert under_way() == ["0", None, None]
    crew._inbox.put((crew._workers[0], 1))
    assert list(crew.listen(Watcher())) == []
    assert under_way() == ["0", "1", "2"]


def test_no_more_runs_at_a_time_than_memory_takes(base, monkeypatch):
    """Have 10 bytes, and jobs of 6, 5, 4, 20 and 3: what fits is begun, and what never fits is tried alone."""
    monkeypatch.setattr(pool, "memory_limit", lambda: 10.0)
    crew, under_way = make_crew(monkeypatch, base, [6, 5, 4, 20, 3])
    crew._fanned_out = True
    assert under_way() == ["0", "2", None]
    crew._workers[0].end(crew)
    assert under_way() == ["1", "2", None]
    crew._workers[1].end(crew)
    assert under_way() == ["1", "4", None]
    crew._workers[0].end(crew)
    assert under_way() == [None, "4", None]
    crew._workers[1].end(crew)
    assert under_way() == ["3", None, None]
    crew._workers[0].end(crew)
    assert not crew.is_busy()


def test_a_script_needs_no_special_shape(base, tmp_path):
    """Run a batch from the top level of a script; a run's own words stay in its log."""
    script = tmp_path / "study.py"
    sweep = write_sweep(tmp_path, base, [50, 100], {**SMALL, "bodies.cube.position": [0.0, 0.3, 0.0]})
    script.write_text(
        "import warpjelly as wj\nprint('once')\n"
        f"batch = wj.run_batch({str(sweep)!r}, output={str(tmp_path / 'out')!r}, device='cpu')\n"
        "print([run['status'] for run in batch.record['runs']])\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert done.stdout == "once\n['finished', 'finished']\n"
    assert done.stderr == ""
    assert "WARNING: body 'cube' starts" in (tmp_path / "out" / "k50" / "run.log").read_text()


def test_a_worker_that_cannot_start_is_the_end_of_the_batch(base, tmp_path, monkeypatch):
    """Break what starts a worker, and read what it says."""
    monkeypatch.setattr(pool, "_START", "import sys; raise ImportError('no such thing')")
    with pytest.raises(EnvironmentFailedError, match="a worker process did not start: ImportError: no such thing"):
        run_batch(make_sweep(base, [50]), output=tmp_path / "out", device="cpu")


def test_dry_run_lists_runs_and_what_they_take(base, tmp_path, start):
    """List a sweep with a run that cannot be; nothing is written, and the figures are those of check."""
    sweep = write_sweep(tmp_path, base, [50, -1, 100], SMALL)
    estimate = estimate_batch(sweep, workers=2, device="cpu")
    first, wrong, second = estimate["runs"]
    assert first.items() >= {"name": "k50", "frames": 10, "particles": 27, "problem": None}.items()
    assert "must be greater" in wrong["problem"]
    assert estimate["memory_bytes"] == first["memory_bytes"] + second["memory_bytes"]
    assert estimate_batch(make_sweep(base, [50]), workers=9, device="cpu")["workers"] == 1
    assert estimate["seconds"] == pytest.approx(max(first["seconds"], second["seconds"]))
    longer = estimate_batch(make_sweep(base, [50, 100]), frames=19, workers=1, device="cpu")
    assert longer["seconds"] == pytest.approx(sum(run["seconds"] for run in longer["runs"]))
    cli = start(sweep, "--dry-run")
    code, out, _ = cli.end()
    assert (code, cli.folder.exists()) == (0, False)
    assert re.search(r"k50 +10 +27 +0\.\d\d GB +\S+ s  k = 50\n", out)
    assert "cannot begin" in out


def test_time_is_estimated_once_for_runs_of_one_structure(base, monkeypatch):
    """Count forecasts: one for all stiffnesses, with twice the time for twice the frames; one more for other bodies."""
    from warpjelly.batch import estimate

    forecasts = []
    monkeypatch.setattr(
        estimate,
        "forecast",
        lambda scene, device, threads: (
            forecasts.append(scene) or {"seconds": 1.0, "particles": 1, "springs": 1, "memory_bytes": 1}
        ),
    )
    estimator = estimate.Estimator()
    for settings, seconds in (
        ({"frames": 11}, 1.0),
        ({"frames": 21, STIFFNESS: 3.0}, 2.0),
        ({"frames": 11, "solver.dt": 2.5e-4}, 67 / 34),
        ({"frames": 11, "bodies.cube.particles_per_edge": 4}, 1.0),
        ({"frames": 11, "solver.dt": "auto"}, 1.0),
        ({"frames": 11, "solver.dt": "auto", STIFFNESS: 3.0}, 1.0),
    ):
        scene = load_scene(base, overrides=settings)
        assert estimator.forecast(scene, device="cpu")["seconds"] == pytest.approx(seconds)
    assert len(forecasts) == 4


def test_a_scene_too_large_for_the_memory_leaves_the_others_listed(base, monkeypatch):
    """Let memory end while one scene is built, where the system allows less than the estimate knows of."""
    from warpjelly.batch import estimate

    def forecast(scene: Any, **options: Any) -> dict[str, Any]:
        if scene.bodies[0].particles_per_edge > 4:
            raise MemoryError
        return {"seconds": 1.0, "particles": 1, "springs": 1, "memory_bytes": 1}

    monkeypatch.setattr(estimate, "forecast", forecast)
    sweep = Sweep(base=base, vary={"bodies.cube.particles_per_edge": [3, 5, 4]})
    problems = [run["problem"] for run in estimate_batch(sweep, workers=1, device="cpu")["runs"]]
    assert [problem is None for problem in problems] == [True, False, True]
    assert "out of memory; lower the resolution" in problems[1]


def test_the_live_display_shows_the_batch_and_every_worker(base):
    """Tell the display of two runs, and read what is on the terminal."""
    terminal = io.StringIO()
    console = Console(file=terminal, force_terminal=True, width=120)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
    scene = load_scene(base, overrides=SMALL)
    first, second = (Job(name, scene, Path(name), 1) for name in ("k[1]", "k2"))
    with Progress(*columns, console=console, auto_refresh=False) as progress:
        live = Live(progress)
        live.begin([first, second], done=3)
        live.advance("1", first, 4)
        live.advance("2", second, 1)
        progress.refresh()
        shown = terminal.getvalue()
        assert "2 of 5 runs are to be done" in shown
        assert re.search(r"batch.*3/5 runs, [\d,]+ frames/s, \d:\d\d left", shown)
        assert "k[1]" in shown
        assert "4/10 frames" in shown
        # Another worker goes on with it.
        live.advance("3", first, 4)
        assert live.frames_done == 4 + 1
        live.end("3", first, Result("k[1]", 3, "it diverged"))
        live.end("2", second, Result("k2", 0, None))
        progress.refresh()
        last = terminal.getvalue()[len(shown) :]
        assert "k[1]: it diverged" in last
        assert "k2: finished" not in last
        assert re.search(r"5/5 runs \(1 failed\), [\d,]+ frames/s, 0:00 left", last)
        assert live.frames_done == 4 + 10
        live.begin([first], done=0)
        live.advance("1", first, 4)
        live.end("1", first, Result("k[1]", INTERRUPTED, "interrupted after 4 of 10 frames"))
        progress.refresh()
        last = terminal.getvalue()
        assert re.search(r"k\[1\] .* interrupted", last)
        assert "(2 failed)" not in last


def test_unforeseen_errors_are_told_and_logged(base, tmp_path, monkeypatch):
    """Let a run raise what nobody expects: the result has it in a line, the log with its place."""

    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("what?")

    monkeypatch.setattr("warpjelly.batch.perform.simulate", fail)
    result = perform(Job("a", load_scene(base, overrides=SMALL), tmp_path / "a", 1), device="cpu")
    assert result.exit_code == 4
    assert str(result.reason).startswith("internal error: ZeroDivisionError: what? (test_batch.py:")
    log = (tmp_path / "a" / "run.log").read_text()
    assert "Traceback" in log
    assert str(result.reason) in log


def test_an_engine_gives_its_gpus_to_the_workers_in_turn(monkeypatch):
    """Pretend two GPUs."""
    monkeypatch.setattr(pool, "gpus", lambda: ["cuda:0", "cuda:1"])
    engine = LocalEngine()
    assert (engine.devices, engine.workers) == (["cuda:0", "cuda:1"], 2)
    assert LocalEngine(workers=5).workers == 5
    assert LocalEngine(workers=5, most=3).workers == 3
    assert LocalEngine(device="cpu").workers == available_cores()
    for workers in (0, -1):
        for make in (LocalEngine, RayEngine):
            with pytest.raises(InputError, match=f"workers = {workers}: must be at least 1"):
                make(workers=workers)


def test_a_process_may_be_killed_by_a_signal_without_a_name():
    """Bury a worker that a signal of the system's own has ended."""
    worker = object.__new__(pool._Worker)
    worker._ready = True
    for number, name in ((signal.SIGSEGV, "SIGSEGV"), (35, "signal 35")):
        worker._process = SimpleNamespace(wait=lambda number=number: -number)  # type: ignore[assignment]
        assert worker.bury() == f"its process was killed by {name}"
