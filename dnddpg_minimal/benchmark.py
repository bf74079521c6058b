"""How fast is it? Steps a second beside a peer, an update beside its bare products.

    measured         beside                                   how
    steps a second   stable-baselines3's DDPG (extra `dev`)   same task, sizes, batch
    one update       the matrix products that it calls        same arrays, same buffers
    peak memory      a limit of 900 MB                        a process of its own

Each number is the median of several rounds. In a round everybody has one turn, A B C,
A B C, so that a machine that slows down for a while slows everybody down. One thread
each: more threads on networks this small mostly wait for each other.

The same work: the same task made by the same function, the same hidden layers, batch,
replay, warm-up, noise and learning rates, one step of the environment and one update
in turn. The clock runs after the warm-up only.
"""

from __future__ import annotations

import importlib.util
import math
import os
import platform
import subprocess
import sys
import time
from datetime import date
from functools import partial
from importlib.metadata import version
from statistics import median

import numpy as np
from threadpoolctl import threadpool_limits

from .dnddpg import ALGORITHMS, Batch, Config, NumpyAgent, Training, make_env
from .study import processor

# task, hidden layers, batch size, steps in one turn
SIZES = [
    ("Pendulum-v1", (64, 64), 64, 1_000),
    ("HalfCheetah-v5", (128, 128), 128, 400),
    ("HalfCheetah-v5", (400, 300), 256, 150),
]
WARMUP = 1_000  # steps
CAPACITY = 100_000  # transitions in replay
UPDATES = 10  # in one turn; under Table 1 the slow copies move once in ten
MEGABYTE = 1e6
PEER = "stable-baselines3"


# --- Steps a second -------------------------------------------------------------------


def our_run(config, steps):
    """A Training of config, past its warm-up, as a function: `steps` steps more."""
    training = Training(config)

    def go_on():
        until = training.step + steps
        while training.step < until:  # a record comes at this step, or sooner
            next(training)
        assert training.step == until

    while training.step < config.warmup:
        next(training)
    return go_on


def peer_run(config, steps):
    """The same work (config, steps) by stable-baselines3's DDPG, as `our_run` gives it.

    ImportError where that package is not installed.
    """
    from stable_baselines3 import DDPG
    from stable_baselines3.common.noise import NormalActionNoise

    env = make_env(config)
    zeros = np.zeros(env.action_space.shape)
    model = DDPG(
        "MlpPolicy", env, learning_rate=config.critic_lr,
        buffer_size=config.buffer_size, learning_starts=config.warmup,
        batch_size=config.batch_size, tau=config.tau, gamma=config.gamma, train_freq=1,
        gradient_steps=1, action_noise=NormalActionNoise(zeros, zeros + config.sigma),
        policy_kwargs={"net_arch": list(config.hidden)}, device="cpu", seed=0)

    def go_on(steps=steps):
        model.learn(steps, log_interval=None, reset_num_timesteps=False)

    go_on(config.warmup)
    return go_on


def contestants(task, hidden, batch_size, steps, warmup):
    """Who takes turns on one task: {(algorithm, program): function that starts it}.

    hidden and batch_size are everybody's; `warmup` steps come first, then turns of
    `steps` steps.
    """
    def config(algorithm, backend):
        return Config(task, algorithm, hidden=hidden, batch_size=batch_size,
                      backend=backend, noise="gaussian", sigma=0.1, warmup=warmup,
                      steps=10**9, buffer_size=CAPACITY,
                      yield_every=math.gcd(steps, warmup),
                      evaluate_every=10**9)

    starts = {}
    for backend, program in (("numpy", "NumpyAgent"), ("torch", "TorchAgent")):
        for algorithm in ALGORITHMS:
            starts[algorithm, program] = partial(
                our_run, config(algorithm, backend), steps)
    starts["DDPG", PEER] = partial(peer_run, config("DDPG", "numpy"), steps)
    return starts


def steps_a_second(size, rounds, warmup=WARMUP):
    """Rows of the table for one task: everybody in turn, `rounds` times.

    size: a row of SIZES; warmup: steps before the clock runs.
    """
    task, hidden, batch_size, steps = size
    runs, missing = {}, {}
    for name, start in contestants(*size, warmup).items():
        try:
            runs[name] = start()
        except ImportError as error:
            missing[name] = f"not installed ({error.name})"
    rates = {name: [steps / s for s in seconds]
             for name, seconds in alternate(runs, rounds).items()}
    peer = rates.get(("DDPG", PEER))
    what = "steps a second", f"{task}, {shape(hidden)}, batch {batch_size}"
    for name, rate in rates.items():
        beside = f"{median(rate) / median(peer):.1f} x the peer" if peer else ""
        yield (*what, *name, f"{median(rate):.0f}", spread(rate, "{:.0f}"), beside)
    for name, reason in missing.items():
        yield (*what, *name, "-", "-", reason)


# --- An update and its bare matrix products -------------------------------------------


class Watched(np.ndarray):
    """An array that notes each matrix product it takes part in, in `calls`."""

    calls = []

    def __array_ufunc__(self, ufunc, method, *inputs, out=None, **kwargs):
        inputs = [bare(x) for x in inputs]
        if out is not None:
            kwargs["out"] = tuple(bare(x) for x in out)
        if ufunc is np.matmul:
            Watched.calls.append((*inputs, kwargs.get("out")))
        return watched(getattr(ufunc, method)(*inputs, **kwargs))


def bare(array):
    """The array without its watching."""
    return array.view(np.ndarray) if isinstance(array, Watched) else array


def watched(array):
    """The array, so that matrix products with it are noted."""
    return array.view(Watched) if isinstance(array, np.ndarray) else array


def change_arrays(agent, view):
    """Replace every array of an agent by view(array): the same memory, in place."""
    def change(value):
        if isinstance(value, np.ndarray):
            return view(value)
        if isinstance(value, list):
            return [change(item) for item in value]
        if isinstance(value, dict):
            return {key: change(item) for key, item in value.items()}
        return value

    for name, value in vars(agent).items():
        setattr(agent, name, change(value))


def products_of(agent, batch):
    """The matrix products in one update on a batch, as the arguments of `np.matmul`.

    They are the agent's own arrays: shapes, strides and buffers are those of a real
    update. Where an update lets NumPy make the result's memory, `out` is None.
    """
    agent.update(batch)  # now every buffer exists
    change_arrays(agent, watched)
    Watched.calls = []
    agent.update(batch)
    change_arrays(agent, bare)
    return Watched.calls


def update_beside_products(algorithm, rounds, updates):
    """One row: an update of an algorithm at Table 1's size, beside its bare products.

    The two take turns, `rounds` times; a turn is so many `updates`.
    """
    config = Config.paper("HalfCheetah-v5", algorithm)
    env = make_env(config)
    (obs_dim,), (action_dim,) = env.observation_space.shape, env.action_space.shape
    agent, size = NumpyAgent(config, obs_dim, action_dim), config.batch_size
    batch = random_batch(size, obs_dim, action_dim)
    products = products_of(agent, batch)

    def update():
        for _ in range(updates):
            agent.update(batch)

    def multiply():
        for _ in range(updates):
            for first, second, out in products:
                np.matmul(first, second, out=out)

    seconds = alternate({"update": update, "products": multiply}, rounds)
    milliseconds = [1e3 * s / updates for s in seconds["update"]]
    ratios = [u / p for u, p in zip(seconds["update"], seconds["products"])]
    yield ("one update, ms", f"Table 1: {shape(config.hidden)}, batch {size}",
           algorithm, "NumpyAgent", f"{median(milliseconds):.2f}",
           spread(milliseconds, "{:.2f}"),
           f"{median(ratios):.2f} x its {len(products)} products")


def random_batch(size, obs_dim, action_dim):
    """A Batch of B = `size` random transitions, float32, the same at each call.

    obs_dim is O, action_dim is A; actions lie in [-1, 1].
    """
    rng = np.random.default_rng(0)
    batch = Batch(rng.normal(size=(size, obs_dim)),
                  rng.uniform(-1, 1, (size, action_dim)), rng.normal(size=size),
                  rng.normal(size=(size, obs_dim)), np.zeros(size))
    return Batch(*(part.astype(np.float32) for part in batch))


# --- Peak memory ----------------------------------------------------------------------

HUMANOID = """
import sys, tempfile
import numpy as np
from dnddpg_minimal import Config, Training

def peak():  # bytes
    if sys.platform == "darwin":
        import resource
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Not ru_maxrss: on Linux it begins with the size of the process that started this
    with open("/proc/self/status") as file:
        return next(1024 * int(line.split()[1]) for line in file if "VmHWM" in line)

stored, steps = map(int, sys.argv[1:])
training = Training(Config("Humanoid-v5", "DN-DDPG", warmup=0, buffer_size=stored,
                           steps=2 * stored + steps))
rng = np.random.default_rng(0)
_, (action_dim,), _, (obs_dim,), _ = [a.shape[1:] for a in training.replay.arrays]
for _ in range(stored):
    obs = rng.standard_normal(obs_dim, np.float32)
    training.replay.add(obs, rng.uniform(-1, 1, action_dim), 0.0, obs, False)
training.step = stored  # as if these had been its steps
for record in training:  # to an episode's end: what is saved is the state there
    if record.kind == "episode" and record.step >= stored + steps:
        break
print(peak())
with tempfile.TemporaryDirectory() as folder:
    training.save(folder + "/checkpoint.npz")
print(peak())
"""


def peak_memory(stored, steps):
    """Rows: the most memory that a Humanoid run held, without and with a checkpoint.

    stored: transitions in replay; steps: with an update each, at the least.
    """
    what = "peak memory, MB", f"Humanoid-v5, {stored:,} transitions in replay"
    who = "DN-DDPG", "NumpyAgent"
    if sys.platform not in ("linux", "darwin"):
        yield (*what, *who, "-", "-", "not measured on this system")
        return
    child = subprocess.run(
        [sys.executable, "-c", HUMANOID, str(stored), str(steps)], check=True,
        capture_output=True, text=True, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})
    for moment, used in zip(("training", "with saving a checkpoint"),
                            map(int, child.stdout.split())):
        yield (*what, *who, f"{used / MEGABYTE:.0f}", "-", moment)


# --- Turns, medians, the table --------------------------------------------------------


def alternate(runs, rounds):
    """Let everybody have one turn in each of so many `rounds`.

    runs: a dict from a name to a function. Returns the same names to the seconds of
    each turn, (rounds,).
    """
    seconds = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return seconds


def spread(values, form):
    """The lowest and the highest of values, each written by the format `form`."""
    return f"{form.format(min(values))} to {form.format(max(values))}"


def shape(hidden):
    """The widths of hidden layers as text: (64, 64) is 64-64."""
    return "-".join(map(str, hidden))


HEADER = ("measured", "at", "algorithm", "program", "median", "range", "beside")


def table(rows):
    """The rows as text, columns below each other; Markdown reads it too."""
    rows = [HEADER, *rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADER))]
    lines = [" | ".join(cell.ljust(width) for cell, width in zip(row, widths))
             for row in rows]
    lines = [f"| {line} |" for line in lines]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def machine():
    """One line: when, and on what."""
    programs = [f"Python {platform.python_version()}"]
    for name in ("numpy", "gymnasium", "torch", PEER):
        if importlib.util.find_spec(name.replace("-", "_")):
            programs.append(f"{name} {version(name)}")
    return f"{date.today()}, {processor()}, one thread: {', '.join(programs)}"


def main(argv=None) -> int:
    """`python -m dnddpg_minimal benchmark`: see --help. Returns the exit code."""
    import tyro

    return tyro.cli(command, args=argv, prog="python -m dnddpg_minimal benchmark")


def command(rounds: int = 7, quick: bool = False) -> int:
    """Measure the speed and print a table. About ten minutes on a free machine.

    Nothing else should run meanwhile: the medians forgive a disturbance, not a load.
    Fewer than one round is refused.

    Args:
        rounds: how many turns everybody has; the table shows the median.
        quick: only see that it works: few rounds, few steps; the numbers say little.
    """
    if rounds < 1:
        raise ValueError(f"rounds={rounds} is not allowed: expected 1 or more.")
    sizes, warmup, updates, stored, steps = SIZES, WARMUP, UPDATES, CAPACITY, 300
    if quick:
        sizes = [(*size, 10) for *size, _ in SIZES[:2]]
        warmup, updates, stored, steps = 20, 1, 1_000, 5
        rounds = min(rounds, 2)
    if importlib.util.find_spec("torch"):
        import torch

        torch.set_num_threads(1)
    rows = []
    with threadpool_limits(1):
        for size in sizes:
            rows.extend(steps_a_second(size, rounds, warmup))
        for algorithm in ALGORITHMS:
            rows.extend(update_beside_products(algorithm, rounds, updates))
    rows.extend(peak_memory(stored, steps))
    print(machine())
    print(f"Medians and ranges of {rounds} alternating rounds.\n")
    print(table(rows))
    print(f"\nPeak memory: a process of its own; replay was filled by add(), then came "
          f"{steps} steps or\nmore with an update each.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
