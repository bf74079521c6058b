"""The recorded study: which runs there are, doing them, resuming them, loading them.

A run is a `Config`, a `variant` that names what is special about it, and perhaps one of
the faulty trainings of bugs.py. Its record is one small file,

    recordings/<task>/<variant>/<algorithm>-<seed>.npz

written whole or not at all. A study does the runs whose record is missing, and no
others. Killed by any means and started again, it goes on where it was, bit for bit.

| call | meaning |
|---|---|
| `list_of("quick" or "class" or "paper")` | the list of runs, in the order of doing |
| `record(run, folder)` | do one run, write its record |
| `study(runs, folder, ...)` | do those that are missing, on processes or a cluster |
| `load_study(task, algorithm, ...)` | what was recorded, as tables |
| `load_agent_at(weights, i)` | an agent from recorded weights |

On several machines the study talks to a Dask scheduler (`--scheduler`): recordings'
README says how. It speaks to `concurrent.futures.Executor` only.
"""

import hashlib
import itertools
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
import warnings
import zipfile
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

from dnddpg_minimal import bias
from dnddpg_minimal.dnddpg import (
    ALGORITHMS,
    MUJOCO_TASKS,
    Config,
    Training,
    make_agent,
    read_npz,
    write_npz,
)

FORMAT = 1  # of a record
RECORDINGS = Path(__file__).parent / "recordings"
SMALL = ("Pendulum-v1", "ArmEasy-v0", "ArmHard-v0")
TASKS = (*SMALL, "MountainCarContinuous-v0", *MUJOCO_TASKS)  # small ones first
CHECKPOINT_EVERY = 75  # seconds, then at the next episode's end
PROBE_STEP = 2_000  # a test repeats a run so far, and compares the weights
PICTURES_AT = (0.1, 0.25, 0.5, 1.0)  # of the steps: planes and weights
BINS = 40  # of the histogram of visited states, in each direction
DEATHS = 3  # a run whose process died so often is given up
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS",
                            "MKL_NUM_THREADS"), "1")


# --- 1. Which runs --------------------------------------------------------------------


class Run(NamedTuple):
    config: Config
    variant: str  # also a folder's name: nothing in it that Windows refuses
    bug: str | None = None  # a name of bugs.BUGS

    @property
    def name(self):
        return (f"{self.config.task}/{self.variant}/"
                f"{self.config.algorithm}-{self.config.seed}")


def list_of(name):
    """The runs of a budget, in the order of doing: seed 0 of everything first.

    quick  every task and algorithm, seconds each: does everything work?
    class  what is recorded and shipped
    paper  section 4.3 of the paper: Table 1, 2 000 and 5 000 episodes, ten seeds
    """
    lists = {"quick": _quick, "class": _class, "paper": _paper}
    if name not in lists:
        raise ValueError(f"budget={name!r}: expected one of {', '.join(lists)}.")
    return sorted(lists[name](),
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

    pendulum, car, cheetah, arm = TASKS[:1], TASKS[3:4], MUJOCO_TASKS[:1], TASKS[1:2]
    others = ("Hopper-v5", "Walker2d-v5")
    ddpg, dn = ("DDPG",), ("DN-DDPG",)
    large = dict(steps=50_000, hidden=(400, 300), batch_size=256)
    slow = dict(tau=0.01, target_every=10)
    short = dict(steps=20_000)
    frozen = dict(steps=200_000, freeze_actors_after=100_000)
    success = dict(success_terminates=True)
    bonus = dict(success, reward="distance_and_bonus")

    runs = _many(10, SMALL, ALGORITHMS, "class")
    runs += _many(5, car, ALGORITHMS, "class")
    runs += _many(10, (*cheetah, *others), ALGORITHMS, "class")
    runs += _many(5, ("Humanoid-v5",), ALGORITHMS, "class")
    # The choices of readings.md, one at a time
    for field, values in (("target_rule", ("single", "paired_min", "selected", "soft")),
                          ("act_rule", ("max_min", "first")), ("climbs", ("first",)),
                          ("y_min", (-20.0,))):
        for value in values:
            name = value if isinstance(value, str) else f"{value:g}"
            choice = {field: value}
            runs += _many(10, pendulum, dn, f"{field}={name}", **choice, **short)
    runs += _many(10, pendulum, ALGORITHMS, "slow=paper", **slow, **short)
    runs += _many(3, car, ALGORITHMS, "noise=gaussian", noise="gaussian", sigma=0.1)
    for ends in ("none", "any_end"):
        runs += _many(5, (*car, "Hopper-v5"), ddpg, f"ends={ends}", ends=ends)
        runs += _many(5, arm, ddpg, f"success_terminates,ends={ends}", ends=ends,
                      task_options=success)
    runs += _many(5, arm, ddpg, "success_terminates", task_options=success)
    runs += _many(5, arm, dn, "bonus", task_options=bonus, gamma=0.99)
    # Controls: networks as many weights as DN's, twice the updates, frozen actors
    runs += _many(10, pendulum, ddpg, "hidden=92-92", hidden=(92, 92))
    runs += _many(10, pendulum, ("DCN-DDPG",), "updates_per_step=2", updates_per_step=2)
    runs += _many(1, (*cheetah, "Hopper-v5"), ALGORITHMS, "frozen", **frozen)
    runs += _many(1, ("Walker2d-v5", "Humanoid-v5"), dn, "frozen", **frozen)
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


def record(run, folder, scratch=None, stop=None, every=CHECKPOINT_EVERY):
    """Do one run, or go on with it, and write its record into `folder`.

    Returns (what, data). `what` is "done", "stopped" (`stop`, an Event, was set; the
    checkpoint is written) or "busy" (another process is doing this run). `data` holds
    the record's arrays for a caller on another machine, or None. Checkpoints are in
    `scratch`, by default in the user's cache folder, and made at the first episode's
    end after `every` seconds.
    """
    path = Path(folder) / f"{run.name}.npz"
    checkpoint = Checkpoint(run, folder, scratch)
    with only_one(checkpoint.lock) as free:
        if not free:
            time.sleep(1)
            return "busy", None
        if path.exists():
            return "done", None
        checkpoint.sweep(path)
        training, notes = checkpoint.load()
        started = saved = shown = time.monotonic()
        for item in training:
            measure(run, training, item, notes)
            now = time.monotonic()
            notes.seconds += now - started
            started = now
            if now - shown > 2:
                checkpoint.show(training)
                shown = now
            if stop is not None and stop.is_set():
                checkpoint.save(training, notes)
                return "stopped", None
            if item.kind == "episode" and now - saved > every:
                checkpoint.save(training, notes)
                saved = time.monotonic()
        data = finish(run, training, notes)
        if Path(folder).is_dir():  # not so on a cluster without a common folder
            write_record(path, data)
        checkpoint.remove()
        return "done", data


class Notes:
    """What was measured so far: rows of the tables, and pictures by step."""

    def __init__(self):
        self.evaluations, self.bias, self.probe, self.seconds = [], [], None, 0.0
        self.pictures = {}  # step: dict of arrays

    def save(self, path, **more):
        rows = dict(evaluations=self.evaluations, bias=self.bias, probe=self.probe,
                    seconds=self.seconds, **more)
        arrays = {f"{step}/{name}": array for step, arrays in self.pictures.items()
                  for name, array in arrays.items()}
        write_npz(path, rows=json.dumps(rows), **arrays)

    @classmethod
    def load(cls, path, until):
        """The notes up to the step `until`: later ones will be made again."""
        content, notes = read_npz(path), cls()
        rows = json.loads(str(content.pop("rows")))
        notes.evaluations = [row for row in rows["evaluations"] if row["step"] <= until]
        notes.bias = [row for row in rows["bias"] if row["step"] <= until]
        notes.probe = rows["probe"] if until >= PROBE_STEP else None
        notes.seconds = rows["seconds"]
        for name, array in content.items():
            step, _, name = name.partition("/")
            if int(step) <= until:
                notes.pictures.setdefault(int(step), {})[name] = array
        return notes, rows


def measure(run, training, item, notes):
    """Look at the run at one of its records; does not touch it."""
    config, step = run.config, training.step
    if step == PROBE_STEP and notes.probe is None:
        theta = np.asarray(training.agent.arrays()["theta"])
        notes.probe = dict(step=step, sum=float(theta.sum(dtype=np.float64)),
                           sha256=hashlib.sha256(theta.tobytes()).hexdigest())
    if item.kind != "grid":
        return
    kept = None
    if config.episodes is not None:  # then bias.evaluate can't know the quarters
        quarter = 4 * training.episode // config.episodes
        kept = quarter > (notes.evaluations[-1]["quarter"] if notes.evaluations else 0)
    found = bias.evaluate(training, kept)
    row = found.evaluation | {"tail": found.tail}
    row |= {name: found.operator[name] for name in
            ("delta", "sigma", "kappa", "rho", "actor_distance")}
    for name, losses in (("critic", item.critic_loss), ("actor", item.actor_loss)):
        row |= {f"{name}_loss_{i}": loss for i, loss in enumerate(losses)}
    if config.episodes is not None:
        row["quarter"] = quarter
    notes.evaluations.append(_plain(row))
    notes.bias += [_plain(row) for row in found.bias]
    pictured = run.variant == "class" and config.task in SMALL
    if pictured and step in {round(part * config.steps) for part in PICTURES_AT}:
        picture = bias.plane(training.agent, bias.dynamics(config))
        arrays = {name: picture[name] for name in ("x", "y", "q", "truth")}
        if config.seed < 3:
            arrays["theta"] = training.agent.arrays()["theta"]
        notes.pictures[step] = {name: np.float16(a) for name, a in arrays.items()}


def _plain(row):
    """A row without what the run's name says already, in Python's own numbers."""
    return {name: value.item() if isinstance(value, np.generic) else value
            for name, value in row.items() if name not in ("task", "algorithm", "seed")}


def finish(run, training, notes):
    """The record of a run that is over: a dict of arrays."""
    config, agent = run.config, training.agent
    owed_to(notes.bias, config)
    episodes = [(r.step, r.length, r.episode_return) for r in training.records
                if r.kind == "episode"]
    meta = dict(format=FORMAT, variant=run.variant, bug=run.bug, config=asdict(config),
                obs_dim=agent.obs_dim, action_dim=agent.action_dim,
                steps=training.step, updates=training.updates, probe=notes.probe,
                seconds=round(notes.seconds, 1), versions=versions(),
                processor=processor(), revision=revision(), code=code())
    arrays = dict(first_losses=np.float32(training.first_losses),
                  episodes=np.float32(episodes).reshape(-1, 3))
    for name, rows in (("evaluations", notes.evaluations), ("bias", notes.bias)):
        names = list(rows[0]) if rows else []
        labels = [n for n in names if isinstance(rows[0][n], str)]
        numbers = [n for n in names if n not in labels]
        meta[f"{name}_numbers"], meta[f"{name}_labels"] = numbers, labels
        arrays[name] = np.array([[r[n] for n in numbers] for r in rows], np.float32)
        if labels:
            arrays[f"{name}_labels"] = np.array([[r[n] for n in labels] for r in rows])
    if notes.pictures:
        pictures = [notes.pictures[step] for step in sorted(notes.pictures)]
        arrays["picture_steps"] = np.array(sorted(notes.pictures))
        for name in pictures[0]:
            arrays[f"picture_{name}"] = np.stack([one[name] for one in pictures])
    visited = visits(config.task, training.replay)
    if visited is not None:
        arrays["visits"] = visited
    return dict(meta=json.dumps(meta), **arrays)


def owed_to(rows, config):
    """Add to each row of bias what is owed to lag alone (bias.owed), in place.

    V is the truth at the policy's action, over the same kind of states. MuJoCo's kept
    states are measured four times only: there V is that of the on-policy states.
    """
    series = {}  # (rule, states): {updates: truth}
    for row in rows:
        if row["action"] == "policy" and row["critic"] == "min":
            known = series.setdefault((row["rule"], row["states"]), {})
            if np.isfinite(row["truth"]):
                known[row["updates"]] = row["truth"]
    found = {}
    for (rule, states), own in series.items():
        usual = series.get((rule, "on_policy"), own)
        values = usual if len(usual) > len(own) else own
        owed = bias.owed(np.array([*values]), np.array([*values.values()]), config)
        found[rule, states] = dict(zip(values, owed.tolist(), strict=True))
    for row in rows:
        row["owed"] = found[row["rule"], row["states"]].get(row["updates"], np.nan)


PLANES = {  # task: what a histogram of visits shows, from obs; its ranges
    "Pendulum-v1": (lambda obs: (np.arctan2(obs[:, 1], obs[:, 0]), obs[:, 2]),
                    ((-np.pi, np.pi), (-8.0, 8.0))),
    "MountainCarContinuous-v0": (lambda obs: (obs[:, 0], obs[:, 1]),
                                 ((-1.2, 0.6), (-0.07, 0.07))),
}


def visits(task, replay):
    """How often each cell of the state plane was visited: (y, x), uint32, or None."""
    if task not in PLANES:
        return None
    project, ranges = PLANES[task]
    x, y = project(replay.arrays.obs[:replay.size].astype(np.float64))
    counts, _, _ = np.histogram2d(y, x, bins=BINS, range=ranges[::-1])
    return counts.astype(np.uint32)


# --- 3. Checkpoints, locks, files -----------------------------------------------------


def default_scratch():
    """Where checkpoints lie: the user's cache folder, never the work tree."""
    home = Path.home()
    places = {"win32": os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"),
              "darwin": home / "Library" / "Caches"}
    usual = os.environ.get("XDG_CACHE_HOME") or home / ".cache"
    return Path(places.get(sys.platform, usual)) / "dnddpg_minimal"


class Checkpoint:
    """The files of one unfinished run: its Training, what was measured, a lock."""

    def __init__(self, run, folder, scratch=None):
        self.run = run
        scratch = Path(scratch or default_scratch())
        scratch.mkdir(parents=True, exist_ok=True)
        key = f"{Path(folder).resolve()}|{run.name}|{run.bug}|{run.config.to_json()}"
        stem = hashlib.sha256(key.encode()).hexdigest()[:24]
        self.training, self.notes, self.lock, self.status = (
            scratch / f"{stem}.{end}" for end in
            ("training.npz", "notes.npz", "lock", "status"))

    def save(self, training, notes):
        # In this order: notes may know more than the Training, never less
        notes.save(self.notes, code=code())
        training.save(self.training)

    def load(self):
        """Training and notes as they were saved, or new ones.

        New, too, if the files are damaged, or if other code wrote them: what follows
        would not be what this code makes.
        """
        kind = training_class(self.run.bug)
        with suppress(FileNotFoundError, ValueError, KeyError):
            training = kind.load(self.training)
            notes, more = Notes.load(self.notes, training.step)
            if more["code"] == code() and training.config == self.run.config:
                return training, notes
        return kind(self.run.config), Notes()

    def show(self, training):
        """Say how far the run is, for the study's progress bar."""
        config = training.config
        part = (training.step / config.steps if config.episodes is None
                else training.episode / config.episodes)
        with suppress(OSError):
            self.status.write_text(f"{part:.4f}")

    def progress(self):
        with suppress(OSError, ValueError):
            return float(self.status.read_text())
        return 0.0

    def sweep(self, path):
        """Remove what processes that were killed left half written."""
        for whole in (self.training, self.notes, path):
            for part in whole.parent.glob(f".{whole.name}.*.part"):
                part.unlink(missing_ok=True)

    def remove(self):
        for path in (self.training, self.notes, self.status):
            path.unlink(missing_ok=True)


def training_class(bug):
    if bug is None:
        return Training
    from dnddpg_minimal.bugs import BUGS

    return BUGS[bug][2]


@contextmanager
def only_one(path):
    """True inside `with` for one process at a time. The lock dies with its process."""
    with open(path, "a+b") as file:
        try:
            if os.name == "nt":
                import msvcrt

                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield True


def write_record(path, arrays):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_npz(path, save=np.savez_compressed, **arrays)


def versions():
    found = {"python": platform.python_version()}
    for name in ("numpy", "gymnasium", "mujoco", "torch"):
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
    files = ("dnddpg.py", "arm.py", "bias.py", "bugs.py")
    parts = (Path(__file__).with_name(name).read_bytes() for name in files)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


# --- 4. Many runs ---------------------------------------------------------------------


class Slot:
    """A process of its own, for one run at a time: its death harms no other run."""

    room = 1

    def __init__(self, stop, nice):
        self.start = lambda: ProcessPoolExecutor(
            1, mp_context=get_context("spawn"), initializer=_start_worker,
            initargs=(stop, nice))
        self.executor, self.running = self.start(), 0

    def submit(self, *call):
        try:
            return self.executor.submit(*call)
        except BrokenExecutor:  # its process died while it had nothing to do
            self.renew()
            return self.executor.submit(*call)

    def renew(self):
        self.executor.shutdown(wait=False)
        self.executor = self.start()


class Cluster:
    """All of a Dask cluster. It does lost runs again by itself."""

    room = 10**9

    def __init__(self, address):
        from distributed import Client

        self.client, self.running = Client(address), 0
        self.executor = self.client.get_executor(pure=False)
        self.submit = self.executor.submit

    def renew(self):
        pass


_stop = None  # in a worker: the Event by which the study asks it to stop


def _start_worker(stop, nice):
    global _stop
    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the study hears Ctrl-C, and tells
    if hasattr(os, "nice"):
        os.nice(nice)

    def follow():
        parent_process().join()  # also a study that was killed
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _work(run, folder, scratch, every):
    return record(run, folder, scratch, _stop, every)


def study(runs, folder=RECORDINGS, scratch=None, workers=2, nice=10, scheduler=None,
          every=CHECKPOINT_EVERY,
          report=lambda *_: None):
    """Do the runs whose record is missing. → {name: why} of those that failed.

    `report(done, running)` is called about once a second and after each run, with the
    names of the runs that ended just now and the `Checkpoint`s of those that go on.
    A run whose process dies is done again, at most three times.
    """
    folder = Path(folder).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    waiting = deque(r for r in runs if not (folder / f"{r.name}.npz").exists())
    failed, deaths, futures = {}, Counter(), {}
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # for the workers: read when NumPy is loaded
    stop = get_context("spawn").Event()
    slots = ([Cluster(scheduler)] if scheduler else
             [Slot(stop, nice) for _ in range(min(workers, max(1, len(waiting))))])
    try:
        while waiting or futures:
            for slot in slots:
                while waiting and slot.running < slot.room:
                    run = waiting.popleft()
                    future = slot.submit(_work, run, str(folder), scratch, every)
                    futures[future] = run, slot
                    slot.running += 1
            ended, _ = wait(futures, timeout=1, return_when=FIRST_COMPLETED)
            done = []
            for future in ended:
                run, slot = futures.pop(future)
                slot.running -= 1
                try:
                    what, data = future.result()
                except BrokenExecutor:
                    slot.renew()
                    deaths[run.name] += 1
                    if deaths[run.name] < DEATHS:
                        waiting.appendleft(run)
                        continue
                    failed[run.name] = f"its process died {DEATHS} times"
                except Exception as error:  # whatever it is, the study goes on
                    failed[run.name] = f"{type(error).__name__}: {error}"
                else:
                    if what == "busy":  # done by another study: look again later
                        waiting.append(run)
                        continue
                    path = folder / f"{run.name}.npz"
                    if data is not None and not path.exists():
                        write_record(path, data)
                done.append(run.name)
            going_on = [run for run, _ in futures.values()]
            report(done, [Checkpoint(run, folder, scratch) for run in going_on])
    finally:
        stop.set()
        for slot in slots:
            slot.executor.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    return failed


# --- 5. Loading -----------------------------------------------------------------------

TABLES = ("evaluations", "bias")
WHAT = (*TABLES, "episodes", "planes", "weights", "visits")
WHOLE = ("step", "updates", "n", "seed", "quarter")  # columns of whole numbers


def load_study(task=None, algorithm=None, variant="class", what="evaluations",
               folder=None):
    """What was recorded. `None` for task, algorithm or variant means all of them.

    what="evaluations", "bias": one pandas DataFrame.
    what="episodes", "planes", "weights", "visits": a list of dicts, one per run, each
    with task, algorithm, variant, seed, and arrays:

        episodes  step, length, episode_return                         (E,)
        planes    step (T,), x (N,), y (N,), q (T, C, N, N), truth (T, N, N)
        weights   step (T,), theta (T, P); for `load_agent_at`
        visits    counts (N, N), x (N + 1,) and y (N + 1,), the cells' edges

    T times of the run, N points of an axis; pictures have the axes [y, x]. A damaged
    or foreign file is named in a warning and skipped. ValueError for an unknown `what`.
    """
    if what not in WHAT:
        raise ValueError(f"what={what!r}: expected one of {', '.join(WHAT)}.")
    found = []
    folder = Path(folder or RECORDINGS)
    for path in folder.glob(f"{task or '*'}/{variant or '*'}/{algorithm or '*'}-*.npz"):
        if not path.name.startswith("."):
            with _named(path):
                found += _read(path, what)
    found.sort(key=lambda one: _order(one["task"], one["variant"], one["algorithm"],
                                      one["seed"]))
    return _frame(found) if what in TABLES else found


@contextmanager
def _named(path):
    try:
        yield
    except (ValueError, KeyError, TypeError, IndexError, OSError, EOFError,
            AttributeError, NotImplementedError, zipfile.BadZipFile,
            zipfile.zlib.error) as error:
        warnings.warn(f"{path} is skipped: it is damaged, or no record of this study "
                      f"({type(error).__name__}: {error})", stacklevel=4)


def _order(task, variant, algorithm, seed):
    place = lambda all_, one: all_.index(one) if one in all_ else len(all_)  # noqa: E731
    return (place(TASKS, task), task, variant != "class", variant,
            place(list(ALGORITHMS), algorithm), algorithm, seed)


def read_meta(content):
    """The dict that a record begins with: config, versions, processor, ..."""
    meta = json.loads(str(content["meta"]))
    if meta["format"] != FORMAT:
        raise ValueError(f"format {meta['format']!r}, expected {FORMAT}")
    return meta


def _read(path, what):
    """What one record holds of `what`: a list of one dict, or of none."""
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
        meta = read_meta(content)
        config = meta["config"]
        one = dict(task=config["task"], algorithm=config["algorithm"],
                   variant=meta["variant"], seed=config["seed"])
        if what in TABLES:
            table = content[what].astype(np.float64)
            names = meta[f"{what}_numbers"]
            numbers = dict(zip(names, table.T, strict=True)) if len(table) else {}
            labels = meta[f"{what}_labels"]
            if labels:
                one |= dict(zip(labels, content[f"{what}_labels"].T, strict=True))
            one |= numbers
            if not numbers:
                return []
        elif what == "episodes":
            step, length, total = content["episodes"].T
            one |= dict(step=step.astype(int), length=length.astype(int),
                        episode_return=total)
        elif what == "visits" and "visits" in content:
            (x, y) = PLANES[one["task"]][1]
            one |= dict(counts=content["visits"], x=np.linspace(*x, BINS + 1),
                        y=np.linspace(*y, BINS + 1))
        elif what == "planes" and "picture_q" in content:
            for name in ("x", "y", "q", "truth"):
                one[name] = content[f"picture_{name}"].astype(np.float32)
            one |= dict(step=content["picture_steps"], x=one["x"][0], y=one["y"][0])
        elif what == "weights" and "picture_theta" in content:
            one |= dict(step=content["picture_steps"], config=json.dumps(config),
                        theta=content["picture_theta"].astype(np.float32),
                        obs_dim=meta["obs_dim"], action_dim=meta["action_dim"])
        else:
            return []
    return [one]


def _frame(found):
    """One DataFrame of all runs' rows."""
    import pandas as pd

    names = dict.fromkeys(("task", "algorithm", "variant", "seed", "step", "updates"))
    for one in found:
        names |= dict.fromkeys(one)
    lengths = [len(one["step"]) for one in found]
    columns = {}
    for name in names:
        parts = [np.broadcast_to(one.get(name, np.nan), n)
                 for one, n in zip(found, lengths, strict=True)]
        column = np.concatenate(parts) if parts else np.empty(0)
        columns[name] = column.astype(int) if name in WHOLE[:4] else column
    return pd.DataFrame(columns)


def load_agent_at(weights, i=-1):
    """The agent of a run at its i-th recorded time; `weights` from `load_study`.

    The weights were stored in float16. Slow copies equal the networks, moments are 0:
    for acting and looking, not for going on with the training.
    """
    config = Config.from_json(weights["config"])
    agent = make_agent(config, weights["obs_dim"], weights["action_dim"])
    theta = weights["theta"][i]
    agent.set_arrays(agent.arrays() | dict(theta=theta, theta_target=theta))
    return agent


# --- 6. The command -------------------------------------------------------------------


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
) -> int:
    """Do the runs of a budget that are missing. Ctrl-C stops; the same command goes on.

    Args:
        budget: quick (seconds each), class (what is shipped), paper (section 4.3).
        task: only these tasks.
        algorithm: only these algorithms.
        variant: only these variants.
        seeds: only these seeds.
        workers: processes, one run each.
        nice: how much the workers stand back for other processes (not on Windows).
        folder: where records are written.
        scratch: where checkpoints are written; None: the user's cache folder.
        scheduler: address of a Dask scheduler, tcp://...; its workers do the runs.
        dry_run: only say what would be done, and how long it takes on this machine.
        status: only say what is there and how far the unfinished runs are.
    """
    from tqdm import tqdm

    runs = [run for run in list_of(budget)
            if (not task or run.config.task in task)
            and (not algorithm or run.config.algorithm in algorithm)
            and (not variant or run.variant in variant)
            and (not seeds or run.config.seed in seeds)]
    missing = [run for run in runs if not (folder / f"{run.name}.npz").exists()]
    print(f"{len(runs)} runs, {len(runs) - len(missing)} recorded, "
          f"{len(missing)} to do.", flush=True)
    size = {run.name: work(run.config) for run in missing}
    began, over = time.monotonic(), set()
    with tqdm(total=sum(size.values()), disable=None, unit_scale=True,
              bar_format="{percentage:5.1f} % |{bar}| {remaining} left {desc}") as bar:

        def report(done, running):
            over.update(done)
            part = {c.run.name: c.progress() for c in running}
            bar.n = sum(size[name] * part.get(name, name in over) for name in size)
            bar.set_description_str("  ".join(f"{name} {100 * share:.0f} %" for
                                              name, share in part.items()), False)
            bar.refresh()
            for name in done if bar.disable else ():
                minutes = (time.monotonic() - began) / 60
                print(f"{minutes:7.1f} min  {len(over)}/{len(missing)}  {name}",
                      flush=True)

        try:
            failed = study(missing, folder, scratch, workers, nice, scheduler,
                           report=report)
        except KeyboardInterrupt:
            bar.close()
            print("Stopped. Nothing recorded is lost: the same command goes on.")
            return 130
    for name, why in failed.items():
        print(f"failed: {name}: {why}", file=sys.stderr)
    print(f"{len(missing) - len(failed)} runs done, {len(failed)} failed.")
    return 1 if failed else 0


def work(config):
    """A rough measure of a run's work, to weigh the runs in one progress bar."""
    steps = config.steps or config.episodes * (config.max_episode_steps or 1_000)
    weights = sum(a * b for a, b in itertools.pairwise((*config.hidden, 1)))
    products = config.batch_size * weights * (2 * config.critics + config.actors)
    return steps * (1e-4 + config.updates_per_step * (2e-4 + products / 1e10))


if __name__ == "__main__":
    from dnddpg_minimal.study import main as _main  # workers look for it by this name

    sys.exit(_main())
