"""The recorded study: which runs there are, doing them, resuming them.

A run is a `Config`, a `variant` that names what is special about it ("td3" is trained
by td3.py), and perhaps one of the faulty trainings of bugs.py. Its record is one small
file, written whole or not at all:

    recordings/<task>/<variant>/<algorithm>-<seed>.npz

A study does the runs whose record is missing, and no others. Killed by any means and
started again, it goes on where it was, bit for bit.

| call | meaning |
|---|---|
| `list_of("quick")`, `"class"`, `"paper"` | the runs of a budget, in order of doing |
| `record(run, folder)` | do one run, write its record |
| `study(runs, folder, ...)` | do those that are missing, on processes or a cluster |

What was recorded is loaded by records.py; its `load_study`, `score` and `load_agent_at`
can be imported from here too. `python -m dnddpg_minimal study --help` is the command;
recordings/README.md says how to use it on one machine and on several.
"""

import errno
import gc
import hashlib
import heapq
import itertools
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from dnddpg_minimal import bias
from dnddpg_minimal.dnddpg import (
    ALGORITHMS,
    MUJOCO_TASKS,
    Config,
    Training,
    read_npz,
    write_npz,
)
from dnddpg_minimal.records import (
    BINS,
    FILMED,
    FORMAT,
    PLANES,
    RECORDINGS,
    SMALL,
    TASKS,
    load_agent_at,
    load_study,
    owed,
    score,
    share_of_ends,
    write_readme,
)

__all__ = ["Run", "list_of", "load_agent_at", "load_study", "record", "score", "study"]

CHECKPOINT_EVERY = 50  # seconds, then at the next episode's end: within two minutes
PROBE_STEP = 2_000  # a test repeats a run so far, and compares the weights
PICTURES_AT = (0.1, 0.25, 0.5, 1.0)  # of the steps: planes and weights
DEATHS = 3  # a run whose process died so often is given up
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS",
                            "MKL_NUM_THREADS"), "1")


# --- 1. Which runs --------------------------------------------------------------------


class Run(NamedTuple):
    """One run of a study: its config, what is special about it, perhaps a bug."""

    config: Config
    variant: str  # also a folder's name: nothing in it that Windows refuses
    bug: str | None = None  # a name of bugs.BUGS

    @property
    def name(self):
        """task/variant/algorithm-seed: where its record lies, without the suffix."""
        config = self.config
        return f"{config.task}/{self.variant}/{config.algorithm}-{config.seed}"

    @property
    def trainer(self):
        """The class that trains it: Training, TD3Training, or a faulty one."""
        from dnddpg_minimal.bugs import BUGS
        from dnddpg_minimal.td3 import TD3Training

        if self.bug is not None:
            return BUGS[self.bug][2]
        return TD3Training if self.variant == "td3" else Training


def list_of(budget):
    """The runs of a budget, in the order of doing: seed 0 of everything first.

    quick  every task and algorithm, seconds each: does everything work?
    class  what is recorded and shipped
    paper  section 4.3 of the paper: Table 1, 2 000 or 5 000 episodes; ten seeds

    ValueError for another budget.
    """
    lists = {"quick": _quick, "class": _class, "paper": _paper}
    if budget not in lists:
        raise ValueError(f"budget={budget!r}: expected one of {', '.join(lists)}.")
    return sorted(lists[budget](),
                  key=lambda run: (run.config.seed, TASKS.index(run.config.task)))


def _many(seeds, tasks, algorithms, variant, bug=None, **choices):
    return [Run(Config(task, algorithm, seed, **choices), variant, bug)
            for seed in range(seeds) for task in tasks for algorithm in algorithms]


def _quick():
    return _many(1, TASKS, ALGORITHMS, "quick", steps=400, warmup=200,
                 evaluate_every=200, hidden=(32, 32), batch_size=32)


def _paper():
    return [Run(Config.paper(task, algorithm, seed), "paper")
            for seed in range(10) for task in TASKS for algorithm in ALGORITHMS]


def _class():
    from dnddpg_minimal.bugs import ABLATIONS, BUGS

    pendulum, arm, hard, car = TASKS[:1], TASKS[1:2], TASKS[2:3], TASKS[3:4]
    cheetah, hopper = MUJOCO_TASKS[:1], MUJOCO_TASKS[1:2]
    walker, others = MUJOCO_TASKS[2:3], MUJOCO_TASKS[3:]
    ddpg, dcn, dn = ("DDPG",), ("DCN-DDPG",), ("DN-DDPG",)
    short = dict(steps=20_000)
    slow = dict(tau=0.01, target_every=10)
    success = dict(success_terminates=True)
    bonus = dict(success, reward="distance_and_bonus")
    frozen = dict(steps=200_000, freeze_actors_after=100_000)
    large = dict(steps=50_000, hidden=(400, 300), batch_size=256)

    runs = _many(10, (*SMALL, *cheetah, *hopper, *walker), ALGORITHMS, "class")
    runs += _many(5, (*car, *others), ALGORITHMS, "class")
    # The choices of readings.md, one at a time
    for field, values in (("target_rule", ("single", "paired_min", "selected", "soft")),
                          ("act_rule", ("max_min", "first")), ("climbs", ("first",)),
                          ("y_min", (-20,))):
        for value in values:
            choice = {field: value}
            runs += _many(10, pendulum, dn, f"{field}={value}", **choice, **short)
    runs += _many(10, pendulum, ALGORITHMS, "slow=paper", **slow, **short)
    runs += _many(3, car, ALGORITHMS, "noise=gaussian", noise="gaussian", sigma=0.1)
    # As large as the default's OU noise, but without its memory (chapter 08)
    runs += _many(3, car, ddpg, "noise=gaussian,sigma=0.95", noise="gaussian",
                  sigma=0.95)
    for ends in ("none", "any_end"):
        runs += _many(5, (*car, *hopper), ddpg, f"ends={ends}", ends=ends)
        runs += _many(5, arm, ddpg, f"success_terminates,ends={ends}", ends=ends,
                      task_options=success)
    runs += _many(5, arm, ddpg, "success_terminates", task_options=success)
    runs += _many(5, arm, dn, "bonus", task_options=bonus, gamma=0.99)
    # Controls: networks as many weights as DN's, twice the updates, frozen actors
    runs += _many(10, pendulum, ddpg, "hidden=92-92", hidden=(92, 92))
    runs += _many(10, hard, ddpg, "hidden=184-184", hidden=(184, 184))
    runs += _many(5, hopper, ddpg, "hidden=184-184", hidden=(184, 184))
    runs += _many(5, walker, ddpg, "hidden=186-186", hidden=(186, 186))
    runs += _many(10, (*pendulum, *hard, *cheetah, *hopper, *walker), dcn,
                  "updates_per_step=2", updates_per_step=2)
    # The second actor in half: it acts, but is not in y; or the other way round
    for name, value in (("target_rule", "single"), ("act_rule", "first")):
        runs += _many(10, (*hard, *hopper), dn, f"{name}={value}", **{name: value})
    # The rest of TD3: smoothing and delay
    runs += _many(10, (*cheetah, *hopper, *walker), dcn, "td3", target_every=2)
    runs += _many(10, pendulum, ALGORITHMS, "frozen", freeze_actors_after=20_000)
    runs += _many(1, (*cheetah, *hopper), ALGORITHMS, "frozen", **frozen)
    runs += _many(1, (*walker, *others), dn, "frozen", **frozen)
    # Chapters 03 and 12
    for name, fields in ABLATIONS.items():
        runs += _many(5, pendulum, ddpg, f"ablation={name}", **fields, **short)
    for name, (task, fields, _) in BUGS.items():
        steps = short if task in pendulum else {}
        runs += _many(5, (task,), ddpg, f"bug={name}", bug=name, **fields, **steps)
    # Table 1's sizes, and its literal numbers
    runs += _many(1, cheetah, ALGORITHMS, "400-300", **large)
    runs += _many(1, cheetah, ddpg, "table_1", actor_lr=1e-4, critic_lr=1e-4,
                  **large, **slow)
    return runs


# --- 2. One run -----------------------------------------------------------------------


def record(run, folder, scratch=None, stop=None, every=CHECKPOINT_EVERY, write=True):
    """Do one run, or go on with it, and write its record into `folder`.

    Checkpoints go to `scratch`, by default in the user's cache folder, at the first
    episode's end after `every` seconds. Returns (what, arrays); `what` is

        "done"     `arrays` are the record's, or None if it was there already;
                   with `write=False` the caller writes them, and a copy stays in
                   `scratch`, so that a caller who lost them gets them again
        "stopped"  `stop`, an Event, was set; the checkpoint is written
        "busy"     another process is doing this run
    """
    path = Path(folder) / f"{run.name}.npz"
    writable(scratch or default_scratch(), "--scratch")
    checkpoint = Checkpoint(run, folder, scratch)
    with only_one(checkpoint.lock) as free:
        if not free:
            time.sleep(1)
            return "busy", None
        if path.exists():
            checkpoint.remove()  # a process may have been killed just before it did
            return "done", None
        if checkpoint.record.exists():
            return "done", read_npz(checkpoint.record)
        checkpoint.sweep(path)
        training, notes = checkpoint.load()
        last = saved = shown = time.monotonic()
        for item in training:
            measure(run, training, item, notes)
            now = time.monotonic()
            notes.seconds, last = notes.seconds + now - last, now
            if now - shown > 2:
                checkpoint.show(training)
                shown = now
            if stop is not None and stop.is_set():
                checkpoint.save(training, notes)
                return "stopped", None
            if item.kind == "episode" and now - saved > every:
                checkpoint.save(training, notes)
                saved = time.monotonic()
        training.env.close()
        arrays = finish(run, training, notes)
        write_record(path if write else checkpoint.record, arrays)
        checkpoint.remove()
        return "done", arrays


class Notes:
    """What was measured so far: rows of the tables, and pictures by step."""

    def __init__(self):
        self.evaluations, self.bias, self.probe, self.seconds = [], [], None, 0.0
        self.pictures = {}  # step: dict of arrays

    def save(self, path):
        """Write the notes to one file at `path`, whole or not at all."""
        rows = dict(evaluations=self.evaluations, bias=self.bias, probe=self.probe,
                    seconds=self.seconds, code=code())
        arrays = {f"{step}/{name}": array for step, arrays in self.pictures.items()
                  for name, array in arrays.items()}
        write_npz(path, rows=json.dumps(rows), **arrays)

    @classmethod
    def load(cls, path, until):
        """The notes at `path` up to the step `until`: later ones will be made again.

        ValueError for a damaged file, and for one that other code wrote.
        """
        content, notes = read_npz(path), cls()
        rows = json.loads(str(content.pop("rows")))
        if rows["code"] != code():
            raise ValueError("written by other code: the rest would be of another kind")
        notes.evaluations = [row for row in rows["evaluations"] if row["step"] <= until]
        notes.bias = [row for row in rows["bias"] if row["step"] <= until]
        notes.probe = rows["probe"] if until >= PROBE_STEP else None
        notes.seconds = rows["seconds"]
        for name, array in content.items():
            step, _, name = name.partition("/")
            if int(step) <= until:
                notes.pictures.setdefault(int(step), {})[name] = array
        return notes


def measure(run, training, item, notes):
    """Look at a training at one of its records `item`, and note it. Changes no run."""
    config, step = run.config, training.step
    if step == PROBE_STEP and notes.probe is None:
        notes.probe = fingerprint(training)
    by_episodes = config.episodes is not None
    at_the_end = by_episodes and item.kind == "episode" and training.finished
    if not (item.kind == "grid" or at_the_end):
        return
    if at_the_end:  # this step may have been one of the grid
        for name in ("evaluations", "bias"):
            rows = [row for row in getattr(notes, name) if row["step"] != step]
            setattr(notes, name, rows)
    full = None
    if by_episodes and config.task in MUJOCO_TASKS:  # evaluate can't know the quarters
        quarter = 4 * training.episode // config.episodes
        full = quarter > (notes.evaluations[-1]["quarter"] if notes.evaluations else 0)
    found = bias.evaluate(training, full)
    row = found.evaluation | {"tail": found.tail}
    row |= {name: value for name, value in found.operator.items() if name != "n"}
    for name, losses in (("critic", item.critic_loss), ("actor", item.actor_loss)):
        row |= {f"{name}_loss_{i}": loss for i, loss in enumerate(losses)}
    if full is not None:
        row["quarter"] = quarter
    notes.evaluations.append(_plain(row))
    notes.bias += [_plain(row) for row in found.bias]
    arrays = pictures(run, training.agent, step)
    if arrays:
        kinds = {"x": np.float32, "y": np.float32}
        notes.pictures[step] = {name: kinds.get(name, np.float16)(array)
                                for name, array in arrays.items()}


def fingerprint(training):
    """A training's weights in a short dict: equal only if they are, bit for bit."""
    theta = np.asarray(training.agent.arrays()["theta"])
    return dict(step=training.step, sum=float(theta.sum(dtype=np.float64)),
                sha256=hashlib.sha256(theta.tobytes()).hexdigest())


def pictures(run, agent, step):
    """What a record holds besides numbers: the error plane, and weights.

    Of the `class` runs of Pendulum and the Arms at 10, 25, 50 and 100 %; of the other
    agents that the films show, the weights at the end.
    """
    config, arrays = run.config, {}
    if run.variant == "class" and config.task in SMALL:
        if step in {round(part * config.steps) for part in PICTURES_AT}:
            with threadpool_limits(1):  # one run, one thread
                plane = bias.plane(agent, bias.dynamics(config))
            arrays = {name: plane[name] for name in ("x", "y", "q", "truth")}
            if config.seed < 3:
                arrays["theta"] = agent.arrays()["theta"]
    elif run.name in FILMED and step == config.steps:
        arrays["theta"] = agent.arrays()["theta"]
    return arrays


def _plain(row):
    """A row without what the run's name says already, in Python's own numbers."""
    return {name: value.item() if isinstance(value, np.generic) else value
            for name, value in row.items() if name not in ("task", "algorithm", "seed")}


def finish(run, training, notes):
    """The record of a run whose training is over, with its notes: a dict of arrays.

    `meta` says what is what.
    """
    config, agent = run.config, training.agent
    episodes = np.float32([(r.step, r.length, r.episode_return)
                           for r in training.records if r.kind == "episode"])
    episodes = episodes.reshape(-1, 3)
    owed_to(notes.bias, asdict(config), episodes, run.bug)
    meta = dict(format=FORMAT, variant=run.variant, bug=run.bug, config=asdict(config),
                obs_dim=agent.obs_dim, action_dim=agent.action_dim,
                steps=training.step, updates=training.updates, probe=notes.probe,
                seconds=round(notes.seconds, 1), versions=versions(),
                processor=processor(), blas=blas(), revision=revision(), code=code())
    arrays = dict(first_losses=np.float32(training.first_losses),
                  episodes=episodes)
    for name, rows in (("evaluations", notes.evaluations), ("bias", notes.bias)):
        names = list(rows[0]) if rows else []
        labels = [n for n in names if isinstance(rows[0][n], str)]
        numbers = [n for n in names if n not in labels]
        meta[f"{name}_numbers"], meta[f"{name}_labels"] = numbers, labels
        arrays[name] = np.array([[r[n] for n in numbers] for r in rows], np.float32)
        if labels:
            arrays[f"{name}_labels"] = np.array([[r[n] for n in labels] for r in rows])
    if notes.pictures:
        in_order = [notes.pictures[step] for step in sorted(notes.pictures)]
        arrays["picture_steps"] = np.array(sorted(notes.pictures))
        for name in in_order[0]:
            arrays[f"picture_{name}"] = np.stack([one[name] for one in in_order])
    if config.task in PLANES:
        arrays["visits"] = visits(config.task, training.replay)
    return dict(meta=json.dumps(meta), **arrays)


def owed_to(rows, config, episodes, bug=None):
    """Add to each row of bias what is owed to lag alone (records.owed), in place."""
    columns = {name: np.array([row[name] for row in rows]) for name in
               ("rule", "states", "action", "critic", "step", "updates", "truth")}
    if rows:
        ends = share_of_ends(episodes, columns["step"], config, bug)
        for row, lag in zip(rows, owed(columns, config, ends).tolist(), strict=True):
            row["owed"] = lag


def visits(task, replay):
    """How many states of the replay memory lie in each cell: (BINS y, BINS x).

    task: one of PLANES, which says what a cell is. What lies outside counts in the cell
    at the border: in float32 MountainCar's wall at -1.2 is a little beyond it.
    """
    project, (range_x, range_y) = PLANES[task]
    x, y = project(replay.arrays.obs[:replay.size].astype(np.float64))
    counts, _, _ = np.histogram2d(np.clip(y, *range_y), np.clip(x, *range_x),
                                  bins=BINS, range=(range_y, range_x))
    return counts.astype(np.uint32)


# --- 3. Checkpoints, locks, and where a record comes from -----------------------------


def default_scratch():
    """Where checkpoints lie: the user's cache folder, never the work tree.

    OSError if this user has none.
    """
    name, below_home = {"win32": ("LOCALAPPDATA", "AppData/Local"),
                        "darwin": ("", "Library/Caches")}.get(
                            sys.platform, ("XDG_CACHE_HOME", ".cache"))
    try:
        folder = os.environ.get(name) or Path.home() / below_home
    except RuntimeError as error:  # no home either
        raise OSError(f"no folder for checkpoints ({error}): name one by "
                      "--scratch FOLDER") from error
    return Path(folder) / "dnddpg_minimal"


def writable(folder, option):
    """Make a folder, and try it: hours of work shall not end without a record → Path.

    OSError, with the option that names another folder, if nothing can be written.
    """
    folder = Path(folder).absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise OSError(f"{folder}: nothing can be written there ({error.strerror}). "
                      f"Name another folder: {option} FOLDER") from error


class Checkpoint:
    """The files of one unfinished run: its Training, its Notes, its lock.

    They lie in `scratch`; `folder` is where the record will be.
    """

    def __init__(self, run, folder, scratch=None):
        self.run = run
        scratch = Path(scratch or default_scratch()).absolute()
        key = f"{Path(folder).resolve()}|{run.name}|{run.bug}|{run.config.to_json()}"
        stem = hashlib.sha256(key.encode()).hexdigest()[:24]
        self.training, self.notes, self.record, self.lock, self.status = (
            scratch / f"{stem}.{end}" for end in
            ("training.npz", "notes.npz", "record.npz", "lock", "status"))

    def save(self, training, notes):
        """Write training and notes: a run killed at any moment goes on from here."""
        notes.save(self.notes)  # first: notes may know more than the Training, not less
        training.save(self.training)

    def load(self):
        """Training and Notes as they were saved; new ones if there are none of use."""
        kind = self.run.trainer
        with suppress(FileNotFoundError, ValueError, KeyError):
            training = kind.load(self.training)
            return training, Notes.load(self.notes, training.step)
        return kind(self.run.config), Notes()

    def show(self, training):
        """Say how far a training is, for the study's progress bar."""
        config = training.config
        part = (training.step / config.steps if config.episodes is None
                else training.episode / config.episodes)
        with suppress(OSError):
            self.status.write_text(f"{part:.4f}")

    def progress(self):
        """What `show` said last, 0 to 1."""
        with suppress(OSError, ValueError):
            return float(self.status.read_text())
        return 0.0

    def sweep(self, path):
        """Remove what killed processes left half written, beside `path` too."""
        for whole in (self.training, self.notes, path):
            for part in whole.parent.glob(f"{whole.name}.*.part"):  # see write_npz
                part.unlink(missing_ok=True)

    def remove(self):
        """Delete the files of a run that is recorded."""
        for path in (self.training, self.notes, self.status):
            path.unlink(missing_ok=True)


HELD = errno.EACCES, errno.EAGAIN, errno.EDEADLK  # "another process has the lock"


@contextmanager
def only_one(path):
    """True inside `with` for one process at a time; `path` is the lock's file.

    The lock dies with its process.
    """
    with open(path, "a+b") as file:
        try:
            if os.name == "nt":
                import msvcrt

                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in HELD:  # a file system that knows no locks
                raise
            yield False
        else:
            yield True


def write_record(path, arrays):
    """Write a record's arrays to `path`, compressed, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_npz(path, save=np.savez_compressed, **arrays)


def versions():
    """Versions of Python and of the packages that decide a run's numbers: a dict."""
    found = {"python": platform.python_version()}
    for name in ("numpy", "gymnasium", "mujoco"):
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


@cache
def processor():
    """The processor's model, as the system names it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def blas():
    """The kernels that multiply NumPy's matrices: other ones round otherwise."""
    found = [one for one in threadpool_info() if one["user_api"] == "blas"]
    # SciPy may bring its own, which is there or not by what was imported before
    own = [one for one in found if "numpy" in one["filepath"]] or found
    return [f"{one['internal_api']} {one['version']} {one.get('architecture')}"
            for one in own]


@cache
def revision():
    """The code's revision by git, or None outside a repository."""
    with suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent,
            capture_output=True, text=True, check=True, timeout=10).stdout.strip()


@cache
def code():
    """A digest of the files that decide what a run does."""
    files = ("dnddpg.py", "arm.py", "bias.py", "bugs.py", "td3.py")
    parts = (Path(__file__).with_name(name).read_bytes() for name in files)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


# --- 4. Many runs ---------------------------------------------------------------------


class Slot:
    """A process of its own, for one run at a time: its death harms no other run.

    nice: how much it stands back for other processes.
    """

    room = 1

    def __init__(self, nice):
        self.stop, self.nice, self.running = get_context("spawn").Event(), nice, 0
        self.renew()

    def renew(self):
        """Start a new process."""
        self.executor = ProcessPoolExecutor(
            1, mp_context=get_context("spawn"), initializer=_start_worker,
            initargs=(self.stop, self.nice))

    def submit(self, *call):
        """As Executor.submit; a process that died while idle is replaced first."""
        try:
            return self.executor.submit(*call)
        except BrokenExecutor:  # its process died while it had nothing to do
            self.renew()
            return self.executor.submit(*call)

    def ask_to_stop(self):
        """The run goes on to its next record, and saves its checkpoint."""
        self.stop.set()

    def close(self):
        """Wait for the process to end."""
        self.executor.shutdown(wait=True, cancel_futures=True)


class Cluster:
    """All of the Dask cluster at an address. It does lost runs again by itself."""

    room = 10**9

    def __init__(self, address):
        from distributed import Client

        self.client, self.running = Client(address, timeout=30), 0
        self.executor = self.client.get_executor(pure=False)
        self.submit = self.executor.submit

    def renew(self):
        """Nothing to do: the cluster looks after its workers."""

    def ask_to_stop(self):
        """No further run is begun; one that has begun goes on to its end."""
        self.executor.shutdown(wait=False)

    def close(self):
        """Leave the cluster."""
        self.client.close()


_stop = None  # in a worker: the Event by which the study asks it to stop


def _start_worker(stop, nice):
    global _stop
    _stop = stop
    code(), revision()  # now: the files may change while we run
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the study hears Ctrl-C, and tells
    if hasattr(os, "nice"):
        with suppress(OSError):  # below 0 needs a right
            os.nice(nice)

    def follow():
        parent_process().join()  # also a study that was killed
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _work(run, folder, scratch, every):
    gc.collect()  # the last run's replay memory may be 290 MB
    common = Path(folder).is_dir()  # False on a cluster without a common folder
    try:
        what, arrays = record(run, folder, scratch, _stop, every, write=common)
    except OSError as error:  # "No space left on device" doesn't say which device
        raise OSError(f"{error} (records are written to {folder}, checkpoints to "
                      f"{scratch or default_scratch()})") from error
    if what == "done" and arrays is None:  # it may lie on this machine only
        arrays = read_npz(Path(folder) / f"{run.name}.npz")
    return what, arrays


def study(runs, folder=RECORDINGS, scratch=None, workers=2, nice=10, scheduler=None,
          every=CHECKPOINT_EVERY, report=lambda ended, running: None):
    """Do the runs whose record is missing. → {name: why} of those that failed.

    `workers` processes do one run each at a time; with `scheduler`, an address, a Dask
    cluster does them. `report(ended, running)` is called about once a second: `ended`
    is a dict from the names of the runs that ended just now to "done", or to why they
    failed; `running` are the `Checkpoint`s of those that go on. A
    run whose process dies is done again, at most three times. folder, scratch, every:
    as in `record`; nice: how much the workers stand back for other processes.

    ValueError for fewer than one worker, OSError where nothing can be written.
    """
    if workers < 1:
        raise ValueError(f"workers={workers}: expected 1 or more.")
    folder = writable(folder, "--folder").resolve()
    if scheduler is None:  # a cluster's machines have their own
        writable(scratch or default_scratch(), "--scratch")
    waiting = deque(run for run in runs if not (folder / f"{run.name}.npz").exists())
    failed, deaths, futures = {}, Counter(), {}
    with one_thread():
        slots = ([Cluster(scheduler)] if scheduler else
                 [Slot(nice) for _ in range(min(workers, len(waiting)))])
        try:
            while waiting or futures:
                for slot in slots:
                    while waiting and slot.running < slot.room:
                        run = waiting.popleft()
                        future = slot.submit(_work, run, str(folder), scratch, every)
                        futures[future] = run, slot
                        slot.running += 1
                ended = {}
                for future in wait(futures, 1, FIRST_COMPLETED).done:
                    run, slot = futures.pop(future)
                    slot.running -= 1
                    what = _outcome(future, folder / f"{run.name}.npz")
                    if what == "died":
                        slot.renew()
                        deaths[run.name] += 1
                        what = (f"its process died {DEATHS} times (a crash, a kill, or "
                                "too little memory)")
                        if deaths[run.name] < DEATHS:
                            waiting.appendleft(run)
                            continue
                    if what == "busy":  # done by another study: look again later
                        waiting.append(run)
                        continue
                    if what != "done":
                        failed[run.name] = what
                    ended[run.name] = what
                going_on = [run for run, _ in futures.values()]
                report(ended, [Checkpoint(run, folder, scratch) for run in going_on])
        finally:
            for slot in slots:
                slot.ask_to_stop()
            for slot in slots:
                slot.close()
    return failed


def _outcome(future, path):
    """What became of a run: done, busy, died, or why it failed. Writes its record."""
    try:
        what, arrays = future.result()
        if arrays is not None and not path.exists():
            write_record(path, arrays)
        return what
    except BrokenExecutor:
        return "died"
    except Exception as error:  # whatever it is, the study goes on
        return f"{type(error).__name__}: {error}"


@contextmanager
def one_thread():
    """Processes begun inside give NumPy one thread: it reads these when loaded."""
    before = dict(os.environ)
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name in ONE_THREAD:
            os.environ.pop(name, None)
        os.environ.update((name, before[name]) for name in ONE_THREAD if name in before)


# --- 5. The command -------------------------------------------------------------------


def main(argv=None):
    """`python -m dnddpg_minimal study`: see --help. Returns the exit code."""
    import tyro

    return tyro.cli(command, args=argv, prog="python -m dnddpg_minimal study")


def command(
    budget: Literal["quick", "class", "paper"] = "class",
    task: tuple[str, ...] = (),
    algorithm: tuple[str, ...] = (),
    variant: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    workers: int = 2,
    nice: int = 10,
    folder: Path = RECORDINGS,
    scratch: Path | None = None,
    scheduler: str | None = None,
    dry_run: bool = False,
    status: bool = False,
    readme: bool = False,
    films: bool = False,
) -> int:
    """Do the runs of a budget that are missing. Ctrl-C stops; the same command goes on.

    A choice that leaves no run is refused.

    Args:
        budget: quick (seconds each), class (what is shipped), paper (section 4.3).
        task: only these tasks.
        algorithm: only these algorithms.
        variant: only these variants.
        seeds: only these seeds.
        workers: processes, each with one run at a time.
        nice: how much the workers stand back for other processes (not on Windows).
        folder: where records are written.
        scratch: where checkpoints are written; None: the user's cache folder.
        scheduler: address of a Dask scheduler, tcp://...; its workers do the runs.
        dry_run: only say what is missing, and how long it takes on this machine.
        status: only say what is recorded, and how far the unfinished runs are.
        readme: only write the tables as measured into the folder's README.md.
        films: only film the recorded agents that the book shows.
    """
    if workers < 1:
        raise ValueError(f"workers={workers}: expected 1 or more.")
    if readme:
        write_readme(folder)
        return 0
    if films:
        from dnddpg_minimal.films import film_all

        return film_all(folder)
    runs = [run for run in list_of(budget)
            if (not task or run.config.task in task)
            and (not algorithm or run.config.algorithm in algorithm)
            and (not variant or run.variant in variant)
            and (not seeds or run.config.seed in seeds)]
    if not runs:
        variants = ", ".join(dict.fromkeys(run.variant for run in list_of(budget)))
        raise ValueError(f"no such run in {budget!r}. Its variants: {variants}. Its "
                         f"tasks: {', '.join(TASKS)}.")
    missing = [run for run in runs if not (folder / f"{run.name}.npz").exists()]
    print(f"{len(runs)} runs, {len(runs) - len(missing)} recorded, "
          f"{len(missing)} to do.", flush=True)
    if dry_run or status:
        return tell(runs, missing, folder, scratch, timed=dry_run, workers=workers)
    try:
        with stoppable(), Progress(missing) as progress:
            failed = study(missing, folder, scratch, workers, nice, scheduler,
                           report=progress)
    except KeyboardInterrupt:
        print("Stopped. Nothing recorded is lost: the same command goes on.")
        return 130
    for name, why in failed.items():  # once more, where it is seen
        print(f"failed: {name}: {why}", file=sys.stderr)
    print(f"{len(missing) - len(failed)} runs done, {len(failed)} failed.")
    return 1 if failed else 0


@contextmanager
def stoppable():
    """Inside, Ctrl-C and a polite kill mean the same, also in the background."""
    signals = signal.SIGINT, signal.SIGTERM
    before = [signal.signal(one, signal.default_int_handler) for one in signals]
    try:
        yield
    finally:
        for one, handler in zip(signals, before, strict=True):
            signal.signal(one, handler)


class Progress:
    """One bar for all runs of a study, and what each worker does. Lines in a file."""

    def __init__(self, runs):
        from tqdm import tqdm

        self.size = {run.name: rough_work(run.config) for run in runs}
        self.over, self.seen, self.began = set(), set(), time.monotonic()
        self.held = 0.0  # work that lay in checkpoints: it took no time now
        form = "{percentage:5.1f} % |{bar}| {remaining} left  {desc}"
        self.bar = tqdm(total=sum(self.size.values()), disable=None, bar_format=form)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.bar.close()

    def __call__(self, ended, running):
        self.over.update(ended)
        part = {one.run.name: one.progress() for one in running}
        self.held += sum(self.size[name] * share for name, share in part.items()
                         if name not in self.seen)
        self.seen.update(part)
        self.bar.initial = self.held
        self.bar.n = sum(size * part.get(name, name in self.over)
                         for name, size in self.size.items())
        self.bar.set_description_str("  ".join(
            f"{name} {100 * share:.0f} %" for name, share in part.items() if share))
        for name in ended if self.bar.disable else ():
            minutes = (time.monotonic() - self.began) / 60
            print(f"{minutes:8.1f} min  {len(self.over)} of {len(self.size)}  {name}",
                  flush=True)
        for name, what in ended.items():
            if what != "done":  # now: a study may last for days
                self.bar.write(f"failed: {name}: {what}", file=sys.stderr)


def rough_work(config):
    """A rough measure of the work of a config's run, for one progress bar."""
    steps = config.steps or config.episodes * (config.max_episode_steps or 1_000)
    weights = sum(a * b for a, b in itertools.pairwise((*config.hidden, 1)))
    products = config.batch_size * weights * (2 * config.critics + config.actors)
    return steps * (1e-4 + config.updates_per_step * (2e-4 + products / 1e10))


def tell(runs, missing, folder, scratch, timed, workers):
    """Print which runs are there and which are missing, by task and variant.

    folder, scratch: as in `record`. timed: also the hours, with so many workers.
    """
    groups, seconds = {}, {}  # seconds: of what is left of each run
    for run in runs:
        groups.setdefault((run.config.task, run.variant), []).append(run)
    for (task, variant), group in groups.items():
        todo = [run for run in group if run in missing]
        line = f"{task:26}{variant:34}{len(group) - len(todo):4} of {len(group):3}"
        if timed:
            for run in todo:
                left = 1 - Checkpoint(run, folder, scratch).progress()
                seconds[run.name] = left * seconds_of(run)
            hours = sum(seconds[run.name] for run in todo) / 3600
            line = f"{line}{hours:9.2f} core-hours to do"
        print(line, flush=True)
        for algorithm in dict.fromkeys(run.config.algorithm for run in todo):
            seeds = [run.config.seed for run in todo
                     if run.config.algorithm == algorithm]
            print(f"    to do: {algorithm}, seeds {', '.join(map(str, seeds))}")
    for run in missing:
        part = Checkpoint(run, folder, scratch).progress()
        if part > 0:
            print(f"unfinished: {run.name} {100 * part:.0f} %")
    if timed:
        total, longest = sum(seconds.values()), time_needed(
            [seconds[run.name] for run in missing], workers)
        print(f"{total / 3600:.1f} core-hours, {longest / 3600:.1f} hours with "
              f"{workers} workers, if each has a core of its own. Less where episodes "
              "end early (Hopper, Walker2d, Humanoid).")
    return 0


def time_needed(seconds, workers):
    """Seconds until all is done: each worker takes the next run when it is free.

    seconds: of each run, in order. One run is never shared.
    """
    free = [0.0] * workers  # when each worker is free
    for one in seconds:
        heapq.heapreplace(free, free[0] + one)
    return max(free)


def seconds_of(run):
    """Seconds that a run will take here, from a short one of the same sizes.

    An upper bound where episodes end early (Hopper, Walker2d, Humanoid).
    """
    config = run.config
    steps, limit = config.steps, config.max_episode_steps or 1_000
    if steps is None:
        steps = config.episodes * limit
    learning, measuring, in_full, plane = probe(
        config.task, config.algorithm, config.hidden, config.batch_size,
        config.updates_per_step)
    drawn = len(PICTURES_AT) if run.variant == "class" else 0
    return (steps * learning + steps / config.evaluate_every * measuring + in_full
            + drawn * plane)


@cache
def probe(task, algorithm, hidden, batch_size, updates_per_step):
    """Seconds: a step with its updates, an evaluation, all the full ones, a plane.

    Measured on a short run with these fields of `Config`.
    """
    config = Config(task, algorithm, hidden=hidden, batch_size=batch_size, steps=300,
                    updates_per_step=updates_per_step, warmup=150, yield_every=50)
    clock = {}  # step: seconds of processor time
    for item in (training := Training(config)):
        clock.setdefault(item.step, time.process_time())
    walking, learning = ((clock[step + 100] - clock[step]) / 100 for step in (50, 200))
    if task in MUJOCO_TASKS:  # as if every episode lasted to its time limit
        acting = walking + 5e-5  # and the policy's own time
        return learning, 5 * 1_000 * acting, 4 * 64 * 2 * 500 * acting, 0.0
    training.kept = (training.kept * bias.RECENT)[:bias.RECENT]  # as many as later
    begun = time.process_time()
    bias.evaluate(training)  # here each one is full
    measured, plane = time.process_time(), 0.0
    if task in SMALL:
        with threadpool_limits(1):
            bias.plane(training.agent, bias.dynamics(config))
        plane = time.process_time() - measured
    return learning, measured - begun, 0.0, plane
