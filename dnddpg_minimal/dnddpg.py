"""DDPG, DCN-DDPG and DN-DDPG in one file and one code path.

The three algorithms of Zhang, Xu, Zhang and Liu (2022), "Network Architecture for
Optimizing Deep Deterministic Policy Gradient Algorithms", differ in two numbers:

    algorithm   critics C   actors K
    DDPG            1           1
    DCN-DDPG        2           1
    DN-DDPG         2           2

Networks of one kind stand side by side: every array of weights has a leading axis
(C critics or K actors), and all of them are views into one flat vector.

    equation of the paper                        here
    (1)  slow copies ("target networks") follow  Agent.update
    (2)  J = E[r1 + gamma r2 + ...]              what Training tries to make large
    (3)  mean squared TD error                   Agent.update, NumpyAgent.fit_critics
    (4)  policy gradient                         Agent.update, NumpyAgent.climb_critics
    (5)-(10) overestimation                      measured, in bias.py
    (11) y = r + gamma min of two critics        next_value, td_target
    (12) the better of two actions               choose_actor, Agent.act

Where the paper is silent or contradicts itself, the choice is a field of `Config`,
and the default is named there. The largest difference: Eq. (11) as printed uses one
actor only, so that the second could change nothing in the target. Here the target is
the max over actors of the min over critics (section 3.2 in words); the printed
equation is `target_rule="single"`.

To read the algorithm only, read sections 3 to 6. Section 1 holds its choices, with the
checks of what a user gives; 2, 7 and 8 make a run of it.

Axes: C critics, K actors, B batch, O observation, A action. Actions lie in [-1, 1]
everywhere in this file; `to_env` alone turns them into the units of the task.
"""

import difflib
import json
import math
import os
import re
import threading
import warnings
from copy import copy
from dataclasses import asdict, dataclass
from itertools import pairwise
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from threadpoolctl import ThreadpoolController

# --- 1. Configuration -----------------------------------------------------------------

ALGORITHMS = {"DDPG": (1, 1), "DCN-DDPG": (2, 1), "DN-DDPG": (2, 2)}  # critics, actors

_SMALL = dict(steps=40_000, hidden=(64, 64), batch_size=64, gamma=0.99, tau=0.005,
              noise="gaussian", sigma=0.1, warmup=1_000, evaluate_every=1_000)
_ARM = _SMALL | dict(hidden=(128, 128), batch_size=128, gamma=0.95, sigma=0.3)
_CAR = _SMALL | dict(steps=100_000, noise="ou", sigma=0.5, evaluate_every=5_000)
_MUJOCO = _SMALL | dict(steps=100_000, hidden=(128, 128), batch_size=128,
                        evaluate_every=5_000)
_PROBE = _SMALL | dict(steps=10_000, hidden=(32, 32), gamma=0.9, tau=0.05, warmup=500)
MUJOCO_TASKS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Humanoid-v5")
PROBE_TASKS = ("ConstantReward-v0", "RealEnd-v0", "ObservedReward-v0", "TwoSteps-v0",
               "LinearQuadratic-v0")
PRESETS = {"Pendulum-v1": _SMALL, "ArmEasy-v0": _ARM, "ArmHard-v0": _ARM,
           "MountainCarContinuous-v0": _CAR, **dict.fromkeys(MUJOCO_TASKS, _MUJOCO),
           **dict.fromkeys(PROBE_TASKS, _PROBE)}  # any other task: the row of Pendulum
MAX_REPLAY = 100_000  # transitions, Table 1, row 6

CHOICES = dict(
    target_rule=("max_min", "single", "paired_min", "selected", "soft"),
    act_rule=("paired", "max_min", "first"), climbs=("own", "first"),
    init=("independent", "tied_actors", "tied_critics"), noise=("gaussian", "ou"),
    ends=("terminated", "none", "any_end"), backend=("numpy", "torch"),
    dtype=("float32", "float64"))
_ABOVE_0 = math.ulp(0.0)  # the smallest number above 0
LIMITS = {name: limits for limits, names in {  # lowest (an int: whole numbers), highest
    (0, math.inf): "seed warmup updates_per_step freeze_actors_after",
    (1, math.inf): "critics actors steps episodes max_episode_steps target_every "
                   "evaluate_every yield_every",
    (1, 10**9): "batch_size buffer_size",
    (0.0, 1.0): "gamma theta nu",
    (0.0, 1e9): "sigma",
    (-1e9, 1e9): "y_min",
    (_ABOVE_0, 1.0): "tau noise_decay critic_lr actor_lr",
}.items() for name in names.split()}  # fmt: skip


def _nearest(value, choices):
    """A question with the choice that is spelled most like `value`, or no text."""
    lower = {str(choice).lower(): choice for choice in choices}
    near = difflib.get_close_matches(str(value).lower(), lower, n=1, cutoff=0.4)
    return f" Did you mean {lower[near[0]]!r}?" if near else ""


def _wrong(name, value, expected):
    """The ValueError that names a wrong value, and says what was expected."""
    return ValueError(f"{name}={value!r} is not allowed: expected {expected}")


def _no_choice(name, value, choices):
    """The ValueError for a wrong choice, with the nearest correct spelling."""
    allowed = ", ".join(map(repr, choices))
    return _wrong(name, value, f"one of {allowed}.{_nearest(value, choices)}")


def _number(name, value, low, high):
    """`value` as a plain int or float. ValueError if it is not within the limits."""
    kind = Integral if isinstance(low, int) else Real
    if isinstance(value, kind) and not isinstance(value, bool) and low <= value <= high:
        return type(low)(value)
    words = "a whole number" if kind is Integral else "a number"
    lowest = "above 0" if low == _ABOVE_0 else f"{low:g} or more"
    highest = "" if high == math.inf else f", at most {high:g}"
    raise _wrong(name, value, f"{words}, {lowest}{highest}.")


@dataclass(frozen=True)
class Config:
    """Every choice of one run. What is not given comes from the task's preset.

    `algorithm` sets `critics` and `actors`; they may be given instead (then the name
    is derived, else "C3-K2"). Nothing given means DN-DDPG. Numbers that contradict a
    given name are refused with a ValueError, as is every other value out of range.
    (`dataclasses.replace` keeps what the preset gave: for another task or algorithm
    make a new Config.)
    """

    task: str = "Pendulum-v1"  # name of a Gymnasium task
    algorithm: str | None = None  # DDPG, DCN-DDPG or DN-DDPG
    seed: int = 0  # 0, 1, 2, ...; the source of every random number of the run
    critics: int | None = None  # C, number of critics, 1 or more
    actors: int | None = None  # K, number of actors, 1 to C; actor k climbs critic k
    steps: int | None = None  # environment steps of the whole run, 1 or more
    episodes: int | None = None  # 1 or more: end after so many instead (no steps then)
    max_episode_steps: int | None = None  # time limit, 1 or more; None: the task's
    task_options: dict[str, Any] | None = None  # passed to the environment
    hidden: tuple[int, ...] | None = None  # widths of the hidden layers, 1 or more
    batch_size: int | None = None  # B, transitions in one update, 1 or more
    gamma: float | None = None  # γ, discount of one step, 0 to 1
    tau: float | None = None  # τ of Eq. (1), 0 < τ <= 1; 1 copies outright
    target_every: int = 1  # updates between two moves of the slow copies, 1 or more
    critic_lr: float = 1e-3  # α, learning rate of the critics (Adam), 0 < α <= 1
    actor_lr: float = 1e-3  # α, learning rate of the actors (Adam), 0 < α <= 1
    warmup: int | None = None  # first steps, 0 or more: uniform actions, no update
    buffer_size: int | None = None  # 1 to 1e9 transitions; None: min(steps, 100 000)
    updates_per_step: int = 1  # updates after each step, 0 or more
    noise: str | None = None  # exploration: gaussian, or ou (Ornstein-Uhlenbeck)
    sigma: float | None = None  # σ of the noise, 0 to 1e9, in half action ranges
    theta: float = 0.15  # θ of the OU noise, pull towards 0 in one step, 0 to 1
    noise_decay: float = 1.0  # factor of the noise after each episode, 0 < it <= 1
    target_rule: str = "max_min"  # max_min, single, paired_min, selected or soft
    act_rule: str = "paired"  # paired (Eq. 12 as printed), max_min or first
    climbs: str = "own"  # actor k climbs critic k (own), or all climb the first
    init: str = "independent"  # independent, tied_actors or tied_critics
    ends: str = "terminated"  # what cuts a bootstrap: terminated, none or any_end
    y_min: float | None = None  # lower limit of y, ±1e9, in units of return
    nu: float = 0.1  # ν of target_rule soft: weight of the min over actors, 0 to 1
    freeze_actors_after: int | None = None  # a step: after it only the critics learn
    evaluate_every: int | None = None  # steps, 1 or more, from "grid" record to record
    yield_every: int = 250  # steps, 1 or more, from "progress" record to record
    backend: str = "numpy"  # numpy (gradients by hand) or torch (autograd)
    device: str = "cpu"  # cpu or cuda (backend torch only)
    dtype: str = "float32"  # float32, or float64 for comparing the two agents

    def __post_init__(self):
        mine = vars(self)  # the fields; written here, since `self.x = 1` is frozen
        for name, limits in LIMITS.items():
            if mine[name] is not None or getattr(Config, name) is not None:  # default
                mine[name] = _number(name, mine[name], *limits)
        mine.update(self._networks())
        for name, value in PRESETS.get(str(self.task), _SMALL).items():
            if mine[name] is None and (name != "steps" or self.episodes is None):
                mine[name] = value
        if self.buffer_size is None:
            mine["buffer_size"] = min(self.steps or MAX_REPLAY, MAX_REPLAY)
        for name, allowed in CHOICES.items():
            if mine[name] not in allowed:
                raise _no_choice(name, mine[name], allowed)
        self._check_the_rest()
        mine["device"] = str(self.device)
        mine["hidden"] = tuple(_number("hidden", n, 1, math.inf) for n in self.hidden)

    def _networks(self):
        """C, K and the algorithm's name, from whichever of them were given."""
        spelled = re.fullmatch(r"C([1-9]\d*)-K([1-9]\d*)", str(self.algorithm))
        if self.algorithm is None:
            critics = self.critics or max(2, self.actors or 0)
            actors = self.actors or min(2, critics)
        elif spelled:
            critics, actors = int(spelled[1]), int(spelled[2])
        elif str(self.algorithm) in ALGORITHMS:
            critics, actors = ALGORITHMS[str(self.algorithm)]
        else:
            raise _no_choice("algorithm", self.algorithm, (*ALGORITHMS, "C3-K2"))
        if self.critics not in (None, critics) or self.actors not in (None, actors):
            raise ValueError(f"critics={self.critics}, actors={self.actors} contradict "
                             f"algorithm={self.algorithm!r}, which has {critics} and "
                             f"{actors}. Give the name or the numbers, not both.")
        names = {numbers: name for name, numbers in ALGORITHMS.items()}
        name = names.get((critics, actors), f"C{critics}-K{actors}")
        return dict(critics=critics, actors=actors, algorithm=name)

    def _check_the_rest(self):
        if not isinstance(self.task, str):
            raise _wrong("task", self.task, "the name of a task.")
        if self.steps is not None and self.episodes is not None:
            raise ValueError(f"steps={self.steps} and episodes={self.episodes}: "
                             "give one of the two; it says when the run ends.")
        if not (isinstance(self.hidden, list | tuple) and self.hidden):
            raise _wrong("hidden", self.hidden, "widths such as (64, 64).")
        try:  # now, as a file will hold them: tuples become lists
            options = json.loads(json.dumps(self.task_options or {}))
            vars(self)["task_options"] = dict(options)
        except (TypeError, ValueError) as error:
            raise _wrong("task_options", self.task_options, "a dict such as "
                         "{'goal_area': 'window'}, of what JSON can hold "
                         f"({error}).") from error
        if self.actors > self.critics:
            raise _wrong("actors", self.actors, "actors <= critics, since actor k "
                         f"climbs critic k; got critics={self.critics}.")
        if self.target_rule == "paired_min" and self.actors != self.critics:
            raise _wrong("target_rule", "paired_min", "as many actors as critics; got "
                         f"actors={self.actors}, critics={self.critics}.")
        devices = "cpu" if self.backend == "numpy" else r"cpu|cuda(:\d+)?"
        if not re.fullmatch(devices, str(self.device)):
            raise _wrong("device", self.device, "'cpu', or 'cuda' with "
                         "backend='torch'.")

    @classmethod
    def paper(cls, task="HalfCheetah-v5", algorithm="DN-DDPG", seed=0):
        """Table 1, rows 2 to 9 and 11, with section 4.3's episodes and time limits.

        The small tasks take the `class` numbers with those episodes and limits, since
        Table 1 speaks of MuJoCo only. Rows 1 and 10 have no clear meaning: left out.
        task, algorithm and seed are the fields of Config. ValueError for a task that
        has no preset: the paper doesn't speak of it.
        """
        if task not in PRESETS:
            raise _no_choice("task", task, PRESETS)
        table_1 = dict(actor_lr=1e-4, critic_lr=1e-4, hidden=(400, 300), batch_size=256,
                       tau=0.01, gamma=0.99, target_every=10, episodes=5_000)
        small = dict(episodes=2_000, max_episode_steps=300)
        return cls(task, algorithm, seed, buffer_size=MAX_REPLAY,
                   **(table_1 if task in MUJOCO_TASKS else small))

    def to_json(self) -> str:
        """One line of text that `Config.from_json` reads back."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text):
        """The Config in a text of `to_json`. TypeError if it holds unknown fields."""
        return cls(**json.loads(text))


# --- 2. Random numbers and files ------------------------------------------------------

ROLES = "critic actor replay noise warmup environment evaluation keep".split()


def stream(seed, role, index=0):
    """The random stream of one use, fixed by (seed, role, index) alone.

    Each use has its own, so that a second critic or actor moves nobody else's draws.
    """
    return np.random.default_rng([seed, ROLES.index(role), index])


def write_npz(path, save=np.savez, **arrays):
    """Write `arrays` to one `.npz` file at `path`, whole or not at all.

    The file is written under another name, and takes its own name when complete.
    `save=np.savez_compressed` makes it smaller and slower.
    """
    part = Path(f"{path}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        with open(part, "wb") as file:
            save(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def read_npz(path):
    """The arrays of the `.npz` file at `path` as a dict. Never unpickles.

    Raises FileNotFoundError if there is none, ValueError if it is damaged or foreign.
    """
    with open(path, "rb") as file:
        try:
            return dict(np.load(file, allow_pickle=False))
        except Exception as error:  # zipfile and NumPy raise a dozen kinds
            raise ValueError(f"{path} is damaged, or no file of dnddpg_minimal "
                             f"({type(error).__name__}: {error}).") from error


def _array_to_json(array):
    """An array, which `json` cannot write, as a dict, which it can."""
    return dict(dtype=array.dtype.name, shape=array.shape, values=array.tolist())


def _array_from_json(found):
    """The array that `_array_to_json` wrote; any other dict as it is."""
    if found.keys() != {"dtype", "shape", "values"}:
        return found
    return np.array(found["values"], found["dtype"]).reshape(found["shape"])


# --- 3. Replay and exploration noise --------------------------------------------------


class Batch(NamedTuple):
    """B transitions. What `terminated` means was decided when storing (Config.ends)."""

    obs: np.ndarray  # s, (B, O)
    action: np.ndarray  # a, (B, A), in [-1, 1]
    reward: np.ndarray  # r, (B,)
    next_obs: np.ndarray  # s', (B, O)
    terminated: np.ndarray  # (B,), 1 where the world ended, else 0


class ReplayBuffer:
    """The last `capacity` transitions, in float32. A batch is drawn uniformly, by rng.

    obs_dim is O, action_dim is A.
    """

    def __init__(self, capacity, obs_dim, action_dim, rng):
        self.capacity, self.rng = capacity, rng
        shapes = (obs_dim,), (action_dim,), (), (obs_dim,), ()
        self.arrays = Batch(*(np.zeros((capacity, *n), np.float32) for n in shapes))
        self.size = 0  # transitions stored, at most capacity
        self.position = 0  # row that the next transition is written to

    def add(self, obs, action, reward, next_obs, terminated):
        """Store one transition; the oldest makes room when the buffer is full.

        obs and next_obs (O,), action (A,) in [-1, 1]; reward, terminated: one number.
        """
        transition = (obs, action, reward, next_obs, terminated)
        for array, value in zip(self.arrays, transition, strict=True):
            array[self.position] = value
        self.size = max(self.size, self.position + 1)
        self.position = (self.position + 1) % self.capacity

    def sample(self, batch_size) -> Batch:
        """Draw `batch_size` transitions, uniformly and with replacement.

        Raises ValueError if nothing was stored yet.
        """
        if self.size == 0:
            raise ValueError("sample() from an empty ReplayBuffer: add() first.")
        rows = self.rng.integers(self.size, size=batch_size)
        return Batch(*(array.take(rows, axis=0) for array in self.arrays))


class Noise:
    """Exploration noise: Ornstein-Uhlenbeck (dt = 1), x ← x - θx + σ·N(0, 1).

    With θ = 1 nothing is left of the old x: that is Gaussian noise. The config says
    which, and gives σ and θ; action_dim is A; rng draws.
    """

    def __init__(self, config, action_dim, rng):
        self.sigma, self.rng = config.sigma, rng
        self.theta = config.theta if config.noise == "ou" else 1.0
        self.x, self.scale = np.zeros(action_dim), 1.0  # the scale falls by noise_decay

    def reset(self):
        """Start an episode: the OU noise starts from 0 again."""
        self.x[:] = 0

    def sample(self):
        """One draw, (A,), in units of half the action range."""
        kick = self.sigma * self.rng.standard_normal(len(self.x))
        self.x = self.x - self.theta * self.x + kick
        return self.scale * self.x


# --- 4. Networks: N of one shape side by side, gradients by hand ----------------------
#
# Every input and every hidden layer carries one more column that is always 1. The
# bias is then the last row of the weights, and a layer is one matrix product.


def cut(flat, count, sizes):
    """Cut one flat vector into the layers of N networks: views (N, in + 1, out).

    count is N; sizes are the widths from the input to the output.
    """
    layers, start = [], 0
    for n_in, n_out in pairwise(sizes):
        stop = start + count * (n_in + 1) * n_out
        layers.append(flat[start:stop].reshape(count, n_in + 1, n_out))
        start = stop
    return layers


def size_of(count, sizes):
    """Number of weights and biases of `count` networks with these layer sizes."""
    return sum(count * (n_in + 1) * n_out for n_in, n_out in pairwise(sizes))


def first_weights(layers, generators):
    """Fill the layers: network n from generators[n], uniform in ±1/sqrt(inputs).

    As PyTorch's Linear does. The column of ones is not counted as an input.
    """
    for n, rng in enumerate(generators):
        for layer in layers:
            bound = 1 / math.sqrt(layer.shape[1] - 1)
            layer[n] = rng.uniform(-bound, bound, layer[n].shape)


def join(obs, action=None):
    """A network's input: obs (B, O), action (..., B, A) if given, a column of ones."""
    action = obs[:, :0] if action is None else action  # (B, 0): no columns
    x = np.ones((*action.shape[:-1], obs.shape[1] + action.shape[-1] + 1), obs.dtype)
    x[..., :obs.shape[1]] = obs
    x[..., obs.shape[1]:-1] = action
    return x


def forward(layers, x):
    """x (..., B, in + 1) through N networks: the list [x, h, h, ..., z].

    ReLU after every layer but the last; h (N, B, H + 1), z (N, B, out).
    """
    activations = [x]
    # The axes in front, (N,): x may lack them, or have others than the layers
    lead = np.broadcast(x[..., :1, 0], layers[0][..., :1, 0]).shape[:-1]
    for layer in layers[:-1]:
        h = np.empty((*lead, x.shape[-2], layer.shape[-1] + 1), x.dtype)
        h[..., -1] = 1
        np.matmul(activations[-1], layer, out=h[..., :-1])
        np.maximum(h, np.zeros(h.shape[-1], h.dtype), out=h)  # faster than with 0
        activations.append(h)
    return [*activations, activations[-1] @ layers[-1]]


def backward(layers, activations, dz, dlayers=None, inputs=None):
    """The chain rule from the last layer to the first.

    `activations` is what `forward` returned, and `dz` (N, B, out) the loss's gradient
    with respect to z. With `dlayers` the gradients of the layers are written there,
    over what was there. With `inputs`, a slice, the gradient with respect to those
    columns of x is returned, (N, B, columns).
    """
    for i in reversed(range(len(layers))):
        layer, x = layers[i], activations[i]
        if dlayers is not None:
            np.matmul(x.swapaxes(-1, -2), dz, out=dlayers[i])
        if i == 0:
            return None if inputs is None else dz @ layer[:, inputs].swapaxes(-1, -2)
        # With one output the product is an outer product: each number times each.
        product = np.multiply if dz.shape[-1] == 1 else np.matmul
        dx = product(dz, layer.swapaxes(-1, -2))
        dx *= x > 0  # ReLU passes a gradient where its output is positive
        dz = dx[..., :-1]  # nothing before the column of ones


def adam(theta, dtheta, m, v, t, lr, beta1=0.9, beta2=0.999, eps=1e-8):
    """Step t = 1, 2, ... of Adam on a flat vector, in place (Kingma and Ba 2015).

    theta, its gradient dtheta, and the moments m and v are (P,). As PyTorch's: moments
    are bias-corrected, eps stands outside the square root. lr is the learning rate;
    beta1 and beta2, how much of the moments stays.
    """
    correction = math.sqrt(1 - beta2**t)
    m *= beta1
    m += (1 - beta1) * dtheta
    v *= beta2
    v += (1 - beta2) * dtheta**2
    # lr m^ / (sqrt(v^) + eps), where m^ = m / (1 - beta1^t) and v^ = v / (1 - beta2^t)
    theta -= lr * correction / (1 - beta1**t) * (m / (np.sqrt(v) + eps * correction))
    if t % 256 == 0:  # where gradients have died, m fades into numbers so small
        m[np.abs(m) < 1e-25] = 0  # ("denormal") that processors are slow with


# --- 5. Targets and choices -----------------------------------------------------------


def choose_actor(q, rule="paired"):
    """Which actor acts: Eq. (12). q (C, K, B) → index of an actor, (B,), by `rule`:

        paired   argmax over k of critic k at actor k's action   Eq. (12) as printed
        max_min  argmax over k of the min over all critics
        first    always the first actor

    Raises ValueError for another rule, and if `paired` finds more actors than critics.
    """
    actors = range(q.shape[1])
    if rule == "paired":
        if len(actors) > len(q):
            raise ValueError("'paired' needs a critic for each actor; got q "
                             f"{q.shape}, axes (C, K, B).")
        return q[actors, actors].argmax(axis=0)  # over actors
    if rule == "max_min":
        return q.min(axis=0).argmax(axis=0)
    if rule == "first":
        return np.zeros(q.shape[2], int)
    raise _no_choice("act_rule", rule, CHOICES["act_rule"])


def next_value(q_next, rule="max_min", nu=0.1):
    """The value of the next states, (B,), that the target takes from q_next (C, K, B).

    Eq. (11) and Eq. (12): `q_next` holds the slow critics at the slow actors' actions.
    The rules, all minima over the C critics:

        max_min     max over actors of the min                 section 3.2 in words
        single      the min at the first actor's action        Eq. (11) as printed
        paired_min  min over k of critic k at actor k's action (needs K = C)
        selected    the min at the action that Eq. (12) picks
        soft        (1 - ν) · max + ν · min, over actors, of the min

    With C = K = 1 all of them are DDPG's value. Raises ValueError for an unknown rule,
    and for shapes that do not match.
    """
    q_next = np.asarray(q_next)
    if q_next.ndim != 3 or q_next.size == 0:
        raise ValueError(f"q_next has shape {q_next.shape}: expected (C, K, B).")
    critics, actors, size = q_next.shape
    lowest = q_next.min(axis=0)  # (K, B), over critics
    if rule == "max_min":
        return lowest.max(axis=0)  # over actors; (B,)
    if rule == "single":
        return lowest[0]
    if rule == "paired_min":
        if critics != actors:
            raise ValueError("rule='paired_min' needs as many actors as critics; got "
                             f"q_next {q_next.shape}, axes (C, K, B).")
        return q_next[range(actors), range(actors)].min(axis=0)
    if rule == "selected":
        return lowest[choose_actor(q_next, "paired"), np.arange(size)]
    if rule == "soft":
        return (1 - nu) * lowest.max(axis=0) + nu * lowest.min(axis=0)
    raise _no_choice("rule", rule, CHOICES["target_rule"])


def td_target(reward, terminated, q_next, gamma, rule="max_min", nu=0.1, y_min=None):
    """Eq. (11), what critics are drawn to: y = r + γ (1 - terminated) · value of s'.

    The value is `next_value(q_next, rule, nu)`, q_next (C, K, B). `reward` and
    `terminated` are (B,); `terminated` is 1 or True where the world ended. `gamma` is
    the discount of one step, `y_min` a lower limit of y. Returns y (B,), in units of
    return. Raises ValueError for an unknown rule, shapes that do not match, a
    `terminated` that is neither 0 nor 1, and a y that is not finite.
    """
    reward, ends, q_next = map(np.asarray, (reward, terminated, q_next))
    if not (q_next.ndim == 3 and reward.shape == ends.shape == q_next.shape[2:]):
        raise ValueError("td_target expects shapes (B,), (B,) and (C, K, B); got "
                         f"{reward.shape}, {ends.shape} and {q_next.shape}.")
    if not ((ends == 0) | (ends == 1)).all():
        raise ValueError(f"terminated={ends!r}: expected 0 or 1 for each transition.")
    y = reward + gamma * np.where(ends, 0, next_value(q_next, rule, nu))
    if y_min is not None:
        y = np.maximum(y, y_min)
    if not np.isfinite(y).all():
        raise ValueError(f"y is not finite: {y[~np.isfinite(y)][0]!r}. The rewards are "
                         "broken, or the critics have diverged (lower critic_lr?).")
    return y


# --- 6. Agents ------------------------------------------------------------------------


class Agent:
    """What the NumPy and the PyTorch agent share: all but their arithmetic.

        call                   returns       meaning
        act(obs)               (A,), (B, A)  the greedy action, by config.act_rule
        actions(obs)           (K, B, A)     every actor's action
        q_values(obs, action)  (C, B)        every critic's Q
        q_next(next_obs)       (C, K, B)     slow critics at the slow actors' actions
        update(batch)          dict          losses "critic" (C,) and "actor" (K,)

    Observations are (B, O), actions (B, A) in [-1, 1]; NumPy arrays in and out.
    `slow=True` asks the slow copies instead of the networks that learn. obs_dim is O,
    action_dim is A: the widths that the networks get. `theta` is the vector of all
    weights (`Config.theta` is another thing: the pull of the noise).

    Each agent adds the two halves of an update, `fit_critics` and `climb_critics`, and
    what they need: `_array` and `_numpy` turn NumPy's arrays into its own and back,
    `_prepare` follows new weights, `_out` is what networks answer.
    """

    STATE = ("theta", "theta_target", "adam_m", "adam_v")  # flat: critics, then actors

    def __init__(self, config, obs_dim, action_dim):
        self.config, self.obs_dim, self.action_dim = config, obs_dim, action_dim
        self.dtype = np.dtype(config.dtype)
        self.critic_sizes = (obs_dim + action_dim, *config.hidden, 1)
        self.actor_sizes = (obs_dim, *config.hidden, action_dim)
        self.split = size_of(config.critics, self.critic_sizes)  # where actors begin
        self.size = self.split + size_of(config.actors, self.actor_sizes)
        self.climbed = slice(config.actors if config.climbs == "own" else 1)  # critics
        theta, zeros = np.empty(self.size), np.zeros(self.size)
        for role, layers in zip(("critic", "actor"), self.cut(theta), strict=True):
            tied = config.init == f"tied_{role}s"
            first_weights(layers, [stream(config.seed, role, 0 if tied else n)
                                   for n in range(len(layers[0]))])
        self.set_arrays(dict(theta=theta, theta_target=theta, adam_m=zeros,
                             adam_v=zeros, updates=0, climbs=0))

    def cut(self, theta):
        """Views into a flat vector theta (size,): (critics' layers, actors' layers)."""
        return (cut(theta[:self.split], self.config.critics, self.critic_sizes),
                cut(theta[self.split:], self.config.actors, self.actor_sizes))

    def arrays(self):
        """All that learning changes, as copies: STATE, each (size,), and `updates`."""
        state = {name: self._numpy(getattr(self, name)) for name in self.STATE}
        return state | dict(updates=self.updates, climbs=self.actor_updates)

    def set_arrays(self, arrays):
        """Go on from the `arrays` of either agent. ValueError if shapes differ."""
        for name in self.STATE:
            if np.shape(arrays[name]) != (self.size,):
                raise ValueError(f"{name} has shape {np.shape(arrays[name])}: expected "
                                 f"({self.size},)")
            setattr(self, name, self._array(arrays[name]))
        self.updates = int(arrays["updates"])
        self.actor_updates = int(arrays.get("climbs", self.updates))  # not in old files
        self.critic, self.actor = self.cut(self.theta)
        self.critic_target, self.actor_target = self.cut(self.theta_target)
        self._prepare()

    def __getstate__(self):  # for copy and pickle: layers must be cut anew as views
        return self.config, self.obs_dim, self.action_dim, self.arrays()

    def __setstate__(self, state):
        self.__init__(*state[:-1])
        self.set_arrays(state[-1])

    def act(self, obs):
        """The greedy action at obs, without noise: (O,) → (A,) or (B, O) → (B, A)."""
        batch = self._rows(obs, self.obs_dim, "obs")
        actions = self._act(batch)  # (K, B, A)
        action = actions[0]
        if self.config.actors > 1:  # Eq. (12)
            chosen = choose_actor(self._q(batch, actions), self.config.act_rule)
            action = actions[chosen, np.arange(len(batch))]
        return action if np.ndim(obs) == 2 else action[0]

    def actions(self, obs, slow=False):
        """Every actor's action at obs (B, O): (K, B, A)."""
        return self._act(self._rows(obs, self.obs_dim, "obs"), slow)

    def q_values(self, obs, action, slow=False):
        """Every critic's Q at obs (B, O), action (B, A): (C, B)."""
        action = self._rows(action, self.action_dim, "action")
        return self._q(self._rows(obs, self.obs_dim, "obs"), action[None], slow)[:, 0]

    def q_next(self, next_obs):
        """Slow critics at the slow actors' actions, next_obs (B, O): (C, K, B)."""
        next_obs = self._rows(next_obs, self.obs_dim, "next_obs")
        return self._q(next_obs, self._act(next_obs, slow=True), slow=True)

    def _rows(self, array, width, name):
        array = np.atleast_2d(np.asarray(array, self.dtype))
        if array.ndim != 2 or array.shape[1] != width:
            raise ValueError(f"{name} has shape {array.shape}: expected ({width},) or "
                             f"(B, {width}).")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds {array[~np.isfinite(array)][0]}: expected "
                             "finite numbers.")
        return array

    def _act(self, obs, slow=False):
        layers = self.actor_target if slow else self.actor
        return np.tanh(self._out(layers, join(obs)))

    def _q(self, obs, action, slow=False):
        """Every critic at every actor's action (K, B, A): (C, K, B)."""
        layers = self.critic_target if slow else self.critic
        pairs = [layer[:, None] for layer in layers]  # (C, 1, in + 1, out)
        return self._out(pairs, join(obs, action))[..., 0]

    def next_value(self, q_next):
        """The value of next states by the config's rule: (C, K, B) → (B,)."""
        return next_value(q_next, self.config.target_rule, self.config.nu)

    def td_target(self, batch):
        """y (B,) of a batch. No gradient flows through it."""
        value = self.next_value(self.q_next(batch.next_obs))
        # As one critic's and one actor's, (1, 1, B): no rule changes a single value
        return td_target(batch.reward, batch.terminated, value[None, None],
                         self.config.gamma, y_min=self.config.y_min)

    def update(self, batch, climb=True):
        """One update: critics, then actors (if `climb`), then slow copies.

        Returns the losses, "critic" (C,) and "actor" (K,): NaN without a climb. Raises
        ValueError for a batch that is not finite, or whose parts are not equally long,
        before anything has changed.
        """
        config = self.config
        batch = Batch(*(np.asarray(part, self.dtype) for part in batch))
        if len({part.shape[:1] for part in batch}) > 1:
            raise ValueError("batch: expected parts of one length B; got the shapes "
                             f"{', '.join(str(part.shape) for part in batch)}.")
        self._rows(batch.obs, self.obs_dim, "obs")
        self._rows(batch.action, self.action_dim, "action")
        y = self.td_target(batch)  # (B,)
        self.updates += 1
        losses = {"critic": self.fit_critics(batch, y),  # Eq. (3)
                  "actor": np.full(config.actors, np.nan)}
        if climb:
            self.actor_updates += 1
            losses["actor"] = self.climb_critics(batch)  # Eq. (4)
        if self.updates % config.target_every == 0:  # Eq. (1)
            self.theta_target += config.tau * (self.theta - self.theta_target)
        return losses

    def save(self, path):
        """Write weights, slow copies and Adam's moments to one `.npz` at `path`."""
        write_npz(path, config=self.config.to_json(), obs_dim=self.obs_dim,
                  action_dim=self.action_dim, **self.arrays())

    @classmethod
    def load(cls, path):
        """The agent in the file at `path`, by the `save` of an agent or a Training.

        `NumpyAgent.load` makes a NumPy agent of it, `TorchAgent.load` a PyTorch agent.
        Raises ValueError if the file holds no agent, or one of another version.
        """
        content = read_npz(path)
        try:
            config = Config.from_json(str(content["config"]))
            agent = cls(config, int(content["obs_dim"]), int(content["action_dim"]))
            agent.set_arrays(content)
        except (KeyError, TypeError, ValueError) as error:
            lacks = "it lacks " if isinstance(error, KeyError) else ""
            raise ValueError(f"{path} holds no agent that this version can read: "
                             f"{lacks}{error}.") from error
        return agent


class NumpyAgent(Agent):
    """The update with gradients by hand, on flat vectors and views into them."""

    def _array(self, array):
        return np.array(array, self.dtype)

    def _numpy(self, array):
        return array.copy()

    def _prepare(self):
        self.dtheta = np.zeros_like(self.theta)
        self.dcritic, self.dactor = self.cut(self.dtheta)

    def _out(self, layers, x):
        return forward(layers, x)[-1]

    def fit_critics(self, batch, y):
        """Critics: down the mean squared error against y (B,), Eq. (3) → losses (C,).

        What falls is the sum over critics, so that each learns as if it were alone.
        """
        size = len(y)
        activations = forward(self.critic, join(batch.obs, batch.action))
        error = activations[-1][..., 0] - y  # (C, B)
        dq = (2 / size) * error[..., None]  # (C, B, 1)
        backward(self.critic, activations, dq, self.dcritic)
        self._adam(slice(0, self.split), self.updates, self.config.critic_lr)
        return (error * error).sum(axis=1) / size

    def climb_critics(self, batch):
        """Actors: actor k up critic k, through its action a = tanh(z), Eq. (4).

        Returns the losses (K,): minus the mean of Q.
        """
        size = len(batch.obs)
        hidden = forward(self.actor, join(batch.obs))
        action = np.tanh(hidden[-1])  # (K, B, A)
        critic = [layer[self.climbed] for layer in self.critic]
        activations = forward(critic, join(batch.obs, action))
        dq = np.full(activations[-1].shape, -1 / size, self.dtype)  # up is minus down
        daction = backward(critic, activations, dq, inputs=slice(self.obs_dim, -1))
        daction *= 1 - action * action  # through tanh
        backward(self.actor, hidden, daction, self.dactor)
        self._adam(slice(self.split, None), self.actor_updates, self.config.actor_lr)
        return activations[-1][..., 0].sum(axis=1) / -size

    def _adam(self, part, t, lr):
        adam(self.theta[part], self.dtheta[part], self.adam_m[part], self.adam_v[part],
             t, lr)


class TorchAgent(Agent):
    """The same update by autograd, on `config.device`.

    Raises ValueError if PyTorch does not find that device here.
    """

    def __init__(self, config, obs_dim, action_dim):
        import torch

        self.torch, device = torch, torch.device(config.device)
        if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
            raise ValueError(f"device={config.device!r}: PyTorch finds no such GPU.")
        super().__init__(config, obs_dim, action_dim)

    def _array(self, array):
        dtype = getattr(self.torch, self.config.dtype)
        return self.torch.tensor(array, dtype=dtype, device=self.config.device)

    def _numpy(self, tensor):
        return tensor.detach().cpu().numpy().copy()

    def _prepare(self):
        self.critic_adam = self._adam(0, self.updates, self.config.critic_lr)
        self.actor_adam = self._adam(1, self.actor_updates, self.config.actor_lr)

    def _adam(self, part, steps, lr):
        """PyTorch's Adam on critics (part 0) or actors (1), our vectors its moments."""
        layers = (self.critic, self.actor)[part]
        m, v = self.cut(self.adam_m)[part], self.cut(self.adam_v)[part]
        optimizer = self.torch.optim.Adam([x.requires_grad_() for x in layers], lr=lr)
        for i, layer in enumerate(layers):
            step = self.torch.tensor(float(steps))
            optimizer.state[layer] = dict(step=step, exp_avg=m[i], exp_avg_sq=v[i])
        return optimizer

    def _with_ones(self, x):
        return self.torch.nn.functional.pad(x, (0, 1), value=1.0)

    def _forward(self, layers, x):
        """x (..., B, in + 1) through N networks: z (N, B, out), as `forward`."""
        for layer in layers[:-1]:
            x = self._with_ones((x @ layer).relu())
        return x @ layers[-1]

    def _out(self, layers, x):
        with self.torch.no_grad():
            return self._numpy(self._forward(layers, self._array(x)))

    def fit_critics(self, batch, y):
        """Critics: down the mean squared error against y, Eq. (3) → losses (C,)."""
        x = self._array(join(batch.obs, batch.action))
        q = self._forward(self.critic, x)[..., 0]  # (C, B)
        losses = (q - self._array(y)).square().mean(dim=1)
        self._descend(losses.sum(), self.critic, self.critic_adam)
        return self._numpy(losses)

    def climb_critics(self, batch):
        """Actors: actor k up critic k, through its action, Eq. (4) → losses (K,)."""
        obs = self._array(batch.obs)
        action = self._forward(self.actor, self._with_ones(obs)).tanh()  # (K, B, A)
        x = self.torch.cat((obs.expand(len(action), -1, -1), action), dim=2)
        critic = [layer[self.climbed] for layer in self.critic]
        losses = -self._forward(critic, self._with_ones(x))[..., 0].mean(dim=1)
        self._descend(losses.sum(), self.actor, self.actor_adam)
        return self._numpy(losses)

    def _descend(self, loss, layers, optimizer):
        """One step down. No gradient is kept for anyone else's weights."""
        optimizer.zero_grad()
        loss.backward(inputs=layers)
        optimizer.step()


def make_agent(config, obs_dim, action_dim):
    """The agent that `config.backend` names, for these widths of obs and action.

    obs_dim is O, action_dim is A.
    """
    kind = TorchAgent if config.backend == "torch" else NumpyAgent
    return kind(config, obs_dim, action_dim)


# --- 7. The task ----------------------------------------------------------------------

LARGEST = 1e18  # of what a task may hand out: its square still fits into float32


def to_env(action, space):
    """[-1, 1] → the units of the task's action space, (A,) or (B, A).

    The one place where this happens. Bounds may differ by dimension.
    """
    middle, half = (space.high + space.low) / 2, (space.high - space.low) / 2
    return np.minimum(np.maximum(middle + half * action, space.low), space.high)


def make_env(config, render_mode=None):
    """Make `config.task`, or refuse it with a ValueError that says why.

    `render_mode`: None, "human" (a window) or "rgb_array" (pictures), as in Gymnasium.
    """
    named = f"task={config.task!r}"
    shown = {"render_mode": render_mode} if render_mode else {}
    try:
        if "mujoco" in str(gym.spec(config.task).entry_point):
            import mujoco

            # Its warnings as Python's (else it writes a file), less a harmless one
            mujoco.set_mju_user_warning(lambda text: "settotalmass" in text
                                        or warnings.warn(text, stacklevel=2))
        env = gym.make(config.task, max_episode_steps=config.max_episode_steps,
                       disable_env_checker=True, **shown, **config.task_options)
    except (gym.error.Error, ImportError, TypeError) as error:
        why = f"can't be made with task_options={config.task_options}: {error}"
        if ":" in config.task:
            why = "names a module: import it first, and give the name behind the colon."
        elif config.task not in gym.registry:
            why = f"is unknown to Gymnasium.{_nearest(config.task, gym.registry)}"
        raise ValueError(f"{named} {why}") from error
    for name in ("observation_space", "action_space"):
        space = getattr(env, name)
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"{named} has {name} {space}: expected a flat Box of "
                             "numbers (continuous, one axis).")
    if not np.issubdtype(env.action_space.dtype, np.floating):
        raise ValueError(f"{named} has actions of {env.action_space.dtype}: expected "
                         "floating point numbers.")
    if not (np.abs([env.action_space.low, env.action_space.high]) < LARGEST).all():
        raise ValueError(f"{named} has unbounded actions {env.action_space}: expected "
                         "finite bounds, since actors end in tanh.")
    if config.task in PRESETS:  # recorded with actions of more digits than the space's
        return env
    return gym.wrappers.TransformAction(env, env.action_space.dtype.type, None)


def is_mujoco(env):
    """True if env, a Gymnasium environment, runs in MuJoCo."""
    return type(getattr(env.unwrapped, "model", None)).__module__.startswith("mujoco")


def simulator_state(env):
    """The whole state of env as arrays: (state (S,), MuJoCo's xipos (bodies, 3)).

    `xipos` lags one step behind in MuJoCo, and Humanoid's reward reads it, so it must
    be kept too. Both are empty for a task that shows no state.
    """
    inner = env.unwrapped
    if not is_mujoco(env):
        try:
            state = np.array(getattr(inner, "state", ()), float).ravel()
        except Exception:  # something else is called `state` there
            state = np.empty(0)
        return state, np.empty((0, 3))
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(inner.model, kind))
    mujoco.mj_getState(inner.model, inner.data, state, kind)
    return state, inner.data.xipos.copy()


# --- 8. Training ----------------------------------------------------------------------


class Record(NamedTuple):
    """What Training tells its caller.

    `kind` is "episode" (its end), "grid" (a multiple of `evaluate_every`) or
    "progress". Return, length and losses are of the episode, so far if it still runs;
    losses are means over its updates, NaN if there were none, or if not all had one.
    """

    kind: str
    step: int  # environment steps so far
    updates: int
    episode: int  # 0, 1, 2, ...
    episode_return: float  # not discounted
    length: int  # steps
    critic_loss: np.ndarray  # (C,)
    actor_loss: np.ndarray  # (K,)


KEPT = 64  # simulator states kept for the measurement of bias,
KEEP_EVERY = 156  # one from so many steps: 64 from the last 10 000
FIRST_LOSSES = 20  # critic losses kept from the start of the run
_TURN = threading.RLock()  # limits of threads are the process's: one at a time


class Training:
    """One run of a config, as an iterator of `Record`s. It learns; its caller measures.

        training = Training(Config("Pendulum-v1", "DDPG", seed=0))
        for record in training:
            ...                     # training.agent may be measured here

    `save(path)` writes the state at the last episode's end, and `Training.load(path)`
    goes on from there with the same numbers, bit for bit, as if never stopped.
    A subclass may name an agent of its own as its `agent_class`.
    """

    # What a file holds beside weights, replay and random streams
    SMALL = ("step", "episode", "keep_at", "kept", "first_losses")
    agent_class = staticmethod(make_agent)

    def __init__(self, config):
        self.config, self.env = config, make_env(config)
        (obs_dim,), (action_dim,) = (self.env.observation_space.shape,
                                     self.env.action_space.shape)
        self.agent = self.agent_class(config, obs_dim, action_dim)
        if config.backend == "torch" and isinstance(self.agent, NumpyAgent):
            raise _wrong("backend", "torch",
                         f"'numpy' for a {type(self.agent).__name__}.")
        self.streams = {role: stream(config.seed, role) for role in
                        ("replay", "noise", "warmup", "environment", "keep")}
        self.replay = ReplayBuffer(config.buffer_size, obs_dim, action_dim,
                                   self.streams["replay"])
        self.noise = Noise(config, action_dim, self.streams["noise"])
        self.step = self.episode = 0
        self.keep_at = int(self.streams["keep"].integers(KEEP_EVERY))
        self.records, self.kept, self.first_losses = [], [], []
        self._threads = ThreadpoolController()
        self._remember()
        self._loop, self._ended = self._run(), False

    @property
    def updates(self):
        """Updates of the agent so far."""
        return self.agent.updates

    @property
    def finished(self):
        """True when the run's last step, or its last episode, is done."""
        steps, episodes = self.config.steps, self.config.episodes
        return self.step >= steps if episodes is None else self.episode >= episodes

    def __iter__(self):
        return self

    def __next__(self) -> Record:
        with _TURN, self._threads.limit(limits=1):  # one run, one thread
            for record in self._loop:
                return record
        if self._ended:
            raise StopIteration
        raise RuntimeError(f"This run broke off at step {self.step}: save(path), "
                           "then Training.load(path) goes on.")

    def _run(self):
        config = self.config
        while not self.finished:
            seed = int(self.streams["environment"].integers(2**31))
            obs, _ = self.env.reset(seed=seed)
            obs = self._checked(obs)
            self.noise.reset()
            self._return, self._length, over = 0.0, 0, False
            self._losses = [np.zeros(count, self.agent.dtype)  # sums
                            for count in (config.critics, config.actors)]
            self._updates_before = self.updates
            while not (over or self.finished):
                obs, over = self._step(obs)
                if self.step % config.evaluate_every == 0:
                    yield self._record("grid")
                elif self.step % config.yield_every == 0:
                    yield self._record("progress")
            record = self._record("episode" if over else "progress")
            self.episode += over
            self.noise.scale *= config.noise_decay
            self._remember()
            yield record
        self._ended = True

    def _step(self, obs):
        """One step of the environment, then the updates. → next obs, over."""
        config = self.config
        action = self._explore(obs)
        if self.step == self.keep_at:
            self._keep(obs, action)
        self.step += 1
        next_obs, reward, terminated, truncated, _ = self.env.step(
            to_env(action, self.env.action_space))
        next_obs = self._checked(next_obs, reward)
        over = bool(terminated or truncated)
        end = {"terminated": bool(terminated), "none": False,
               "any_end": over}[config.ends]
        self._store(obs, action, reward, next_obs, end)
        self._return += float(reward)
        self._length += 1
        if self.step > config.warmup:
            for _ in range(config.updates_per_step):
                self._update()
        return next_obs, over

    def _checked(self, obs, reward=0.0):
        """A copy of obs, since a task may hand out its own state and change it."""
        shapes, kind = (np.shape(obs), np.shape(reward)), np.asarray(reward).dtype.kind
        if not (shapes == ((self.agent.obs_dim,), ()) and kind in "fiub"
                and abs(reward) < LARGEST and (np.abs(obs) < LARGEST).all()):  # no NaN
            raise ValueError(f"step {self.step} of {self.config.task!r}: reward "
                             f"{reward!r}, observation {obs!r}: expected one finite "
                             f"number, and {self.agent.obs_dim} of them on one axis, "
                             f"all below {LARGEST:g}.")
        return np.array(obs)

    def _explore(self, obs):
        """The action to execute, (A,): uniform at first, then greedy + noise."""
        if self.step < self.config.warmup:
            return self.streams["warmup"].uniform(-1, 1, self.agent.action_dim)
        action = self.agent.act(obs) + self.noise.sample()
        return np.minimum(np.maximum(action, -1), 1)

    def _update(self):
        """One update. Losses are summed over the episode, the run's first ones kept."""
        frozen = self.config.freeze_actors_after
        climb = frozen is None or self.step <= frozen
        batch = self.replay.sample(self.config.batch_size)
        losses = self.agent.update(batch, climb=climb)
        for total, loss in zip(self._losses, losses.values(), strict=True):
            total += loss
        if len(self.first_losses) < FIRST_LOSSES:
            self.first_losses.append(losses["critic"])

    def _record(self, kind):
        updates = self.updates - self._updates_before or math.nan  # in this episode
        losses = [(total / updates).astype(float) for total in self._losses]  # means
        record = Record(kind, self.step, self.updates, self.episode, self._return,
                        self._length, *losses)
        if kind != "progress":
            self.records.append(record)
        return record

    def _keep(self, obs, action):
        """Keep the simulator's state before a step that was drawn beforehand."""
        state, xipos = simulator_state(self.env)
        self.kept.append(dict(step=self.step, state=state, xipos=xipos,
                              obs=np.array(obs, np.float32),
                              action=np.array(action, np.float32)))
        del self.kept[:-KEPT]
        next_window = (self.step // KEEP_EVERY + 1) * KEEP_EVERY
        self.keep_at = next_window + int(self.streams["keep"].integers(KEEP_EVERY))

    # Saving. At each episode's end the small things are copied. The replay memory is
    # not: its rows that are overwritten afterwards are noted, and put back in the file.

    def _remember(self):
        streams = {role: rng.bit_generator.state for role, rng in self.streams.items()}
        small = {name: copy(getattr(self, name)) for name in self.SMALL} | dict(
            noise_scale=self.noise.scale, records=len(self.records), streams=streams,
            kinds=[type(self).__name__, type(self.agent).__name__])
        arrays = self.agent.arrays()  # an interrupt up to here leaves the old three
        self._overwritten, self._arrays, self._small = [], arrays, small

    def _store(self, *transition):
        """Into replay; what it overwrites is noted until the episode's end."""
        row = self.replay.position
        if row < self._small["step"]:  # in use when the episode began
            old = [array[row].copy() for array in self.replay.arrays]
            self._overwritten.append((row, old))
        self.replay.add(*transition)

    def save(self, path):
        """Write the state at the last episode's end to `path`, whole or not at all.

        At the end of the run it is the state then, even in the middle of an episode.
        """
        replay = [array[:self._small["step"]].copy() for array in self.replay.arrays]
        for row, transition in reversed(self._overwritten):
            for array, old in zip(replay, transition, strict=True):
                array[row] = old
        small = self._small | {"records": self.records[:self._small["records"]]}
        write_npz(path, config=self.config.to_json(), obs_dim=self.agent.obs_dim,
                  action_dim=self.agent.action_dim, **self._arrays,
                  small=json.dumps(small, default=_array_to_json),
                  **dict(zip(Batch._fields, replay, strict=True)))

    @classmethod
    def load(cls, path):
        """A Training that goes on where `path` was written. ValueError if damaged."""
        content = read_npz(path)
        try:
            training = cls(Config.from_json(str(content["config"])))
            training._restore(content)
        except (KeyError, TypeError, ValueError) as error:
            lacks = "it lacks " if isinstance(error, KeyError) else ""  # as an agent's
            raise ValueError(f"{path} holds no training that this version can resume: "
                             f"{lacks}{error}.") from error
        return training

    def _restore(self, content):
        small = json.loads(str(content["small"]), object_hook=_array_from_json)
        mine = [type(self).__name__, type(self.agent).__name__]
        if small["kinds"] != mine:
            raise ValueError(f"it is of {' and '.join(small['kinds'])}, and this is "
                             f"{' and '.join(mine)}")
        for name in self.SMALL:
            setattr(self, name, small[name])
        self.records = [Record(*record) for record in small["records"]]
        self.noise.scale = small["noise_scale"]
        for role, rng in self.streams.items():
            rng.bit_generator.state = small["streams"][role]
        for name, array in zip(Batch._fields, self.replay.arrays, strict=True):
            array[:self.step] = content[name]
        self.replay.size = min(self.step, self.replay.capacity)
        self.replay.position = self.step % self.replay.capacity
        self.agent.set_arrays(content)
        self._remember()
