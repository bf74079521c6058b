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
    (1)  slow copies follow                      NumpyAgent.update, TorchAgent.update
    (2)  J = E[r1 + gamma r2 + ...]              what Training tries to make large
    (3)  mean squared TD error                   NumpyAgent.update, TorchAgent.update
    (4)  policy gradient                         NumpyAgent.update, TorchAgent.update
    (5)-(10) overestimation                      measured, in bias.py
    (11) y = r + gamma min of two critics        td_target
    (12) the better of two actions               choose_actor, td_target

Where the paper is silent or contradicts itself, the choice is a field of `Config`,
and the default is named there. The largest difference: Eq. (11) as printed uses one
actor only, so that the second could change nothing in the target. Here the target is
the max over actors of the min over critics (section 3.2 in words); the printed
equation is `target_rule="single"`.

Axes: C critics, K actors, B batch, O observation, A action. Actions lie in [-1, 1]
everywhere in this file; `to_env` alone turns them into the units of the task.
"""

import difflib
import json
import math
import os
import re
import warnings
from dataclasses import asdict, dataclass
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
PRESETS = {
    "Pendulum-v1": _SMALL,
    "ArmEasy-v0": _ARM,
    "ArmHard-v0": _ARM,
    "MountainCarContinuous-v0": _CAR,
    **dict.fromkeys(MUJOCO_TASKS, _MUJOCO),
    **dict.fromkeys(PROBE_TASKS, _PROBE),
}  # any other task takes the row of Pendulum
MAX_REPLAY = 100_000  # transitions, Table 1, row 6

CHOICES = {
    "target_rule": ("max_min", "single", "paired_min", "selected", "soft"),
    "act_rule": ("paired", "max_min", "first"),
    "climbs": ("own", "first"),
    "init": ("independent", "tied_actors", "tied_critics"),
    "ends": ("terminated", "none", "any_end"),
    "noise": ("gaussian", "ou"),
    "backend": ("numpy", "torch"),
    "dtype": ("float32", "float64"),
}
_TINY, _INF = np.nextafter(0, 1), math.inf  # _TINY: the smallest number above 0
RANGES = {  # (kind, lowest, highest): fields
    (Integral, 0, _INF): "seed warmup updates_per_step freeze_actors_after",
    (Integral, 1, _INF): "critics actors steps episodes max_episode_steps batch_size "
                         "target_every buffer_size evaluate_every yield_every",
    (Real, 0, 1): "gamma theta nu",
    (Real, 0, 1e9): "sigma",
    (Real, -1e9, 1e9): "y_min",
    (Real, _TINY, 1): "tau noise_decay critic_lr actor_lr",
}  # fmt: skip
MAY_BE_NONE = "steps episodes max_episode_steps freeze_actors_after y_min".split()


@dataclass(frozen=True)
class Config:
    """Every choice of one run. What is not given comes from the task's preset.

    `algorithm` sets `critics` and `actors`; they may be given instead (then the name
    is derived, else "C3-K2"). Nothing given means DN-DDPG. Numbers that contradict a
    given name are refused with a ValueError, as is every other value out of range.
    """

    task: str = "Pendulum-v1"  # name of a Gymnasium task
    algorithm: str | None = None  # DDPG, DCN-DDPG or DN-DDPG
    seed: int = 0  # 0, 1, 2, ...; the source of every random number of the run
    critics: int | None = None  # C, number of critics
    actors: int | None = None  # K, number of actors, K <= C; actor k climbs critic k
    steps: int | None = None  # environment steps of the whole run
    episodes: int | None = None  # end after so many episodes instead (then no steps)
    max_episode_steps: int | None = None  # time limit; None: the task's own
    task_options: dict[str, Any] | None = None  # passed to the environment
    hidden: tuple[int, ...] | None = None  # widths of the hidden layers
    batch_size: int | None = None  # B, transitions in one update
    gamma: float | None = None  # γ, discount of one step, 0 to 1
    tau: float | None = None  # τ of Eq. (1), 0 < τ <= 1; 1 copies outright
    target_every: int = 1  # updates between two moves of the slow copies
    critic_lr: float = 1e-3  # learning rate of the critics (Adam)
    actor_lr: float = 1e-3  # learning rate of the actors (Adam)
    warmup: int | None = None  # first steps: uniform actions, no update
    buffer_size: int | None = None  # transitions in replay; None: min(steps, 100 000)
    updates_per_step: int = 1  # updates after each step
    noise: str | None = None  # exploration: gaussian, or ou (Ornstein-Uhlenbeck)
    sigma: float | None = None  # σ of the noise, in units of half the action range
    theta: float = 0.15  # θ of the OU noise, pull towards 0 in one step, 0 to 1
    noise_decay: float = 1.0  # noise is multiplied by this after each episode
    target_rule: str = "max_min"  # max_min, single, paired_min, selected or soft
    act_rule: str = "paired"  # paired (Eq. 12 as printed), max_min or first
    climbs: str = "own"  # actor k climbs critic k (own), or all climb the first
    init: str = "independent"  # independent, tied_actors or tied_critics
    ends: str = "terminated"  # what cuts a bootstrap: terminated, none or any_end
    y_min: float | None = None  # lower limit of y, in units of return; None: no limit
    nu: float = 0.1  # ν of target_rule soft: weight of the min over actors, 0 to 1
    freeze_actors_after: int | None = None  # after this step only the critics learn
    evaluate_every: int | None = None  # steps between two records of kind "grid"
    yield_every: int = 250  # steps between two records of kind "progress"
    backend: str = "numpy"  # numpy (gradients by hand) or torch (autograd)
    device: str = "cpu"  # cpu or cuda (backend torch only)
    dtype: str = "float32"  # float32, or float64 for comparing the two agents

    def __post_init__(self):
        def put(name, value):
            object.__setattr__(self, name, value)

        for name, value in zip(("critics", "actors", "algorithm"),
                               self._algorithm(), strict=True):
            put(name, value)
        for name, value in PRESETS.get(self.task, _SMALL).items():
            ended_by_episodes = name == "steps" and self.episodes is not None
            if getattr(self, name) is None and not ended_by_episodes:
                put(name, value)
        if self.steps is not None and self.episodes is not None:
            raise ValueError(f"steps={self.steps!r} and episodes={self.episodes!r}: "
                             "give one of the two; it says when the run ends.")
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ValueError(_not_allowed(name, getattr(self, name), allowed))
        for (kind, low, high), names in RANGES.items():
            for name in names.split():
                put(name, self._number(name, kind, low, high))
        self._check_the_rest()
        put("hidden", tuple(int(width) for width in self.hidden))
        put("task_options", dict(self.task_options or {}))

    def _algorithm(self):
        """(C, K, name) from whichever of them were given."""
        names = {numbers: name for name, numbers in ALGORITHMS.items()}
        free_name = re.fullmatch(r"C(\d+)-K(\d+)", str(self.algorithm))
        if self.algorithm is None:
            critics = max(2, self.actors or 0) if self.critics is None else self.critics
            actors = min(2, critics) if self.actors is None else self.actors
        elif free_name:
            critics, actors = int(free_name[1]), int(free_name[2])
        elif self.algorithm in ALGORITHMS:
            critics, actors = ALGORITHMS[self.algorithm]
        else:
            raise ValueError(_not_allowed("algorithm", self.algorithm, ALGORITHMS))
        for name, fixed in (("critics", critics), ("actors", actors)):
            if getattr(self, name) not in (None, fixed):
                raise ValueError(f"{name}={getattr(self, name)!r} contradicts algorithm="
                                 f"{self.algorithm!r}, which has {fixed}. Give the name "
                                 "or the numbers, not both.")
        return critics, actors, names.get((critics, actors), f"C{critics}-K{actors}")

    def _number(self, name, kind, low, high):
        """The field as a plain int or float; ValueError if it is out of range."""
        value = getattr(self, name)
        if value is None and name == "buffer_size":
            value = min(self.steps or MAX_REPLAY, MAX_REPLAY)
        if value is None and name in MAY_BE_NONE:
            return None
        of_kind = isinstance(value, kind) and not isinstance(value, bool)
        if not (of_kind and low <= value <= high):
            words = "a whole number" if kind is Integral else "a number"
            low = "above 0" if low == _TINY else f"{low} or more"
            high = "" if high == _INF else f", at most {high}"
            raise ValueError(f"{name}={value!r} is not allowed: expected {words}, "
                             f"{low}{high}.")
        return int(value) if kind is Integral else float(value)

    def _check_the_rest(self):
        if not isinstance(self.task, str):
            raise ValueError(f"task={self.task!r}: expected the name of a task.")
        hidden = self.hidden if isinstance(self.hidden, list | tuple) else ()
        if not (hidden and all(isinstance(h, Integral) and h >= 1 for h in hidden)):
            raise ValueError(f"hidden={self.hidden!r} is not allowed: expected widths "
                             "such as (64, 64), whole numbers of 1 or more.")
        if self.actors > self.critics:
            raise ValueError(f"actors={self.actors} with critics={self.critics}: actor "
                             "k climbs critic k, so expected actors <= critics.")
        if self.target_rule == "paired_min" and self.actors != self.critics:
            raise ValueError("target_rule='paired_min' needs as many actors as critics; "
                             f"got actors={self.actors}, critics={self.critics}.")
        if not re.fullmatch(r"cpu|cuda(:\d+)?", str(self.device)):
            raise ValueError(_not_allowed("device", self.device, ("cpu", "cuda")))
        if self.backend == "numpy" and self.device != "cpu":
            raise ValueError(f"device={self.device!r} needs backend='torch'; the NumPy "
                             "agent runs on 'cpu'.")

    @classmethod
    def paper(cls, task="HalfCheetah-v5", algorithm="DN-DDPG", seed=0):
        """Table 1, rows 2 to 9 and 11, with section 4.3's episodes and time limits.

        The small tasks take the `class` numbers with those episodes and limits, since
        Table 1 speaks of MuJoCo only. Rows 1 and 10 have no clear meaning: left out.
        """
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
        """The Config that `to_json` wrote. TypeError if it holds unknown fields."""
        return cls(**json.loads(text))


def _not_allowed(name, value, allowed):
    """The sentence for a wrong choice, with the nearest correct spelling."""
    lower = {str(choice).lower(): choice for choice in allowed}
    near = difflib.get_close_matches(str(value).lower(), lower, n=1, cutoff=0.4)
    hint = f" Did you mean {lower[near[0]]!r}?" if near else ""
    return (f"{name}={value!r} is not allowed: expected one of "
            f"{', '.join(map(repr, allowed))}.{hint}")


# --- 2. Random numbers and files ------------------------------------------------------

ROLES = ("critic", "actor", "replay", "noise", "warmup", "environment", "evaluation",
         "keep")


def stream(seed, role, index=0):
    """The random stream of one use, fixed by (seed, role, index) alone.

    Each use has its own, so that a second critic or actor moves nobody else's draws.
    """
    return np.random.default_rng([seed, ROLES.index(role), index])


def write_npz(path, save=np.savez, **arrays):
    """Write arrays to one `.npz` file, whole or not at all.

    The file is written under another name, and takes its own name when complete.
    `save=np.savez_compressed` makes it smaller and slower.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(part, "wb") as file:
            save(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def read_npz(path):
    """The arrays of a `.npz` file as a dict. Never unpickles.

    Raises FileNotFoundError if there is none, ValueError if it is damaged or foreign.
    """
    with open(path, "rb") as file:
        try:
            return dict(np.load(file, allow_pickle=False))
        except Exception as error:  # zipfile and NumPy raise a dozen kinds
            raise ValueError(f"{path} is damaged, or no file of dnddpg_minimal "
                             f"({type(error).__name__}: {error}).") from error


# --- 3. Replay and exploration noise --------------------------------------------------


class Batch(NamedTuple):
    """B transitions. What `terminated` means was decided when storing (Config.ends)."""

    obs: np.ndarray  # s, (B, O)
    action: np.ndarray  # a, (B, A), in [-1, 1]
    reward: np.ndarray  # r, (B,)
    next_obs: np.ndarray  # s', (B, O)
    terminated: np.ndarray  # (B,), 1 where the world ended, else 0


class ReplayBuffer:
    """The last `capacity` transitions, in float32. A batch is drawn uniformly."""

    def __init__(self, capacity, obs_dim, action_dim, rng):
        self.capacity, self.rng = capacity, rng
        shapes = (obs_dim,), (action_dim,), (), (obs_dim,), ()
        self.arrays = Batch(*(np.zeros((capacity, *shape), np.float32)
                              for shape in shapes))
        self.size = 0  # transitions stored, at most capacity
        self.position = 0  # row that the next transition is written to

    def add(self, obs, action, reward, next_obs, terminated):
        """Store one transition; the oldest makes room when the buffer is full."""
        transition = (obs, action, reward, next_obs, terminated)
        for array, value in zip(self.arrays, transition, strict=True):
            array[self.position] = value
        self.size = max(self.size, self.position + 1)
        self.position = (self.position + 1) % self.capacity

    def sample(self, batch_size) -> Batch:
        """Draw `batch_size` transitions, uniformly and with replacement."""
        if self.size == 0:
            raise ValueError("sample() from an empty ReplayBuffer: add() first.")
        rows = self.rng.integers(self.size, size=batch_size)
        return Batch(*(array.take(rows, axis=0) for array in self.arrays))


class Noise:
    """Exploration noise for one episode: Gaussian or Ornstein-Uhlenbeck (dt = 1)."""

    def __init__(self, config, action_dim, rng):
        self.kind, self.sigma, self.theta = config.noise, config.sigma, config.theta
        self.decay, self.scale, self.rng = config.noise_decay, 1.0, rng
        self.x = np.zeros(action_dim)

    def reset(self):
        """Start an episode: the OU noise starts from 0 again."""
        self.x = np.zeros_like(self.x)

    def sample(self):
        """One draw, (A,), in units of half the action range."""
        kick = self.sigma * self.rng.standard_normal(len(self.x))
        self.x = self.x - self.theta * self.x + kick if self.kind == "ou" else kick
        return self.scale * self.x


# --- 4. Networks: N of one shape side by side, gradients by hand ----------------------
#
# Every input and every hidden layer carries one more column that is always 1. The
# bias is then the last row of the weights, and a layer is one matrix product.


def cut(flat, count, sizes):
    """Cut one flat vector into the layers of N networks: views (N, in + 1, out)."""
    layers, start = [], 0
    for n_in, n_out in zip(sizes[:-1], sizes[1:], strict=True):
        stop = start + count * (n_in + 1) * n_out
        layers.append(flat[start:stop].reshape(count, n_in + 1, n_out))
        start = stop
    return layers


def size_of(count, sizes):
    """Number of weights and biases of `count` networks with these layer sizes."""
    return sum(count * (n_in + 1) * n_out
               for n_in, n_out in zip(sizes[:-1], sizes[1:], strict=True))


def first_weights(layers, generators):
    """Fill the layers: network n from generators[n], uniform in ±1/sqrt(inputs)."""
    for n, rng in enumerate(generators):
        for layer in layers:
            bound = 1 / math.sqrt(layer.shape[1] - 1)
            layer[n] = rng.uniform(-bound, bound, layer[n].shape)


def join(obs, action=None):
    """A network's input: obs (B, O), action (..., B, A) if given, a column of ones."""
    shape = obs.shape if action is None else action.shape
    width = obs.shape[1] + (0 if action is None else shape[-1])
    x = np.ones((*shape[:-1], width + 1), obs.dtype)
    x[..., :obs.shape[1]] = obs
    if action is not None:
        x[..., obs.shape[1]:-1] = action
    return x


def forward(layers, x, scratch=None, name=""):
    """x (..., B, in + 1) through N networks: the list [x, h1, h2, ..., z].

    ReLU after every layer but the last; h (N, B, H + 1), z (N, B, out). `scratch`, a
    dict, lends memory that is used again in the next update under the same `name`.
    """
    scratch = {} if scratch is None else scratch
    activations = [x]
    for i, layer in enumerate(layers[:-1]):
        key = name, i, x.shape
        if key not in scratch:
            lead = np.broadcast_shapes(x.shape[:-2], layer.shape[:-2])
            scratch[key] = np.ones((*lead, x.shape[-2], layer.shape[-1] + 1), x.dtype)
        h = scratch[key]
        np.matmul(activations[-1], layer, out=h[..., :-1])  # the last column stays 1
        np.maximum(h, 0, out=h)
        activations.append(h)
    return [*activations, activations[-1] @ layers[-1]]


def backward(layers, activations, dz, dlayers=None, inputs=None, scratch=None, name=""):
    """The chain rule from the last layer to the first.

    `dz` (N, B, out) is the loss's gradient with respect to z. With `dlayers` the
    gradients of the layers are written there. With `inputs`, a slice, the gradient
    with respect to those columns of x is returned, (N, B, columns).
    """
    scratch = {} if scratch is None else scratch
    for i in reversed(range(len(layers))):
        layer, x = layers[i], activations[i]
        if dlayers is not None:
            np.matmul(x.swapaxes(-1, -2), dz, out=dlayers[i])
        if i == 0:
            return None if inputs is None else dz @ layer[:, inputs].swapaxes(-1, -2)
        key = name, i, x.shape
        # With one output the product is an outer product: each number times each.
        product = np.multiply if dz.shape[-1] == 1 else np.matmul
        dx = product(dz, layer.swapaxes(-1, -2), out=scratch.get(key))
        scratch[key] = dx
        dx *= x > 0  # ReLU passes a gradient where its output is positive
        dz = dx[..., :-1]  # nothing before the column of ones


def adam(theta, dtheta, m, v, t, lr, beta1=0.9, beta2=0.999, eps=1e-8):
    """Step t = 1, 2, ... of Adam on a flat vector, in place (Kingma and Ba 2015).

    As PyTorch's: moments are bias-corrected, eps stands outside the square root.
    Overwrites dtheta.
    """
    correction = math.sqrt(1 - beta2**t)
    m *= beta1
    m += (1 - beta1) * dtheta
    v *= beta2
    dtheta *= dtheta
    dtheta *= 1 - beta2
    v += dtheta
    step = np.sqrt(v, out=dtheta)
    step += eps * correction
    np.divide(m, step, out=step)
    step *= lr * correction / (1 - beta1**t)
    theta -= step
    if t % 256 == 0:  # where gradients have died, m fades into numbers so small
        m[np.abs(m) < 1e-25] = 0  # ("denormal") that processors are slow with


# --- 5. Targets and choices -----------------------------------------------------------


def td_target(reward, terminated, q_next, gamma, rule="max_min", nu=0.1, y_min=None):
    """The value that every critic is drawn to: y = r + γ (1 - terminated) · Q of s'.

    Eq. (11) and Eq. (12): `q_next` (C, K, B) holds the slow critics at the slow
    actors' actions. The rules, all minima over the C critics:

        max_min     max over actors of the min                 section 3.2 in words
        single      the min at the first actor's action        Eq. (11) as printed
        paired_min  min over k of critic k at actor k's action (needs K = C)
        selected    the min at the action that Eq. (12) picks
        soft        (1 - ν) · max + ν · min, over actors, of the min

    With C = K = 1 all of them are DDPG's target. `reward` and `terminated` are (B,),
    `y_min` is a lower limit of y. Returns y (B,), in units of return.
    Raises ValueError for shapes that do not match and for a y that is not finite.
    """
    if np.ndim(q_next) != 3 or not (np.shape(reward) == np.shape(terminated)
                                    == np.shape(q_next)[2:]):
        raise ValueError("td_target expects reward (B,), terminated (B,), q_next "
                         f"(C, K, B); got {np.shape(reward)}, {np.shape(terminated)}, "
                         f"{np.shape(q_next)}.")
    reward, q_next = np.asarray(reward), np.asarray(q_next)
    actors = q_next.shape[1]
    lowest = q_next.min(axis=0)  # (K, B), over critics
    if rule == "max_min":
        value = lowest.max(axis=0)  # over actors; (B,)
    elif rule == "single":
        value = lowest[0]
    elif rule == "paired_min":
        if len(q_next) != actors:
            raise ValueError("rule='paired_min' needs as many actors as critics; got "
                             f"q_next {q_next.shape}, axes (C, K, B).")
        value = q_next[range(actors), range(actors)].min(axis=0)
    elif rule == "selected":
        value = lowest[choose_actor(q_next, "paired"), np.arange(len(reward))]
    elif rule == "soft":
        value = (1 - nu) * lowest.max(axis=0) + nu * lowest.min(axis=0)
    else:
        raise ValueError(_not_allowed("rule", rule, CHOICES["target_rule"]))
    y = reward + gamma * np.where(terminated, 0, value)
    if y_min is not None:
        y = np.maximum(y, y_min)
    if not np.isfinite(y).all():
        raise ValueError(f"y is not finite: {y[~np.isfinite(y)][0]!r}. The rewards are "
                         "broken, or the critics have diverged (lower critic_lr?).")
    return y


def choose_actor(q, rule="paired"):
    """Which actor acts: Eq. (12). q (C, K, B) → index of an actor, (B,).

        paired   argmax over k of critic k at actor k's action   Eq. (12) as printed
        max_min  argmax over k of the min over all critics
        first    always the first actor
    """
    actors = range(q.shape[1])
    if rule == "paired":
        return q[actors, actors].argmax(axis=0)  # over actors
    if rule == "max_min":
        return q.min(axis=0).argmax(axis=0)
    if rule == "first":
        return np.zeros(q.shape[2], int)
    raise ValueError(_not_allowed("act_rule", rule, CHOICES["act_rule"]))


# --- 6. Agents ------------------------------------------------------------------------


class Agent:
    """What the NumPy and the PyTorch agent share.

        call                   returns       meaning
        act(obs)               (A,), (B, A)  the greedy action, by config.act_rule
        actions(obs)           (K, B, A)     every actor's action
        q_values(obs, action)  (C, B)        every critic's Q
        q_next(next_obs)       (C, K, B)     slow critics at the slow actors' actions
        update(batch)          dict          losses "critic" (C,) and "actor" (K,)

    Observations are (B, O), actions (B, A) in [-1, 1]; NumPy arrays in and out.
    `slow=True` asks the slow copies instead of the networks that learn.
    """

    def __init__(self, config, obs_dim, action_dim):
        self.config, self.obs_dim, self.action_dim = config, obs_dim, action_dim
        self.dtype = np.dtype(config.dtype)
        self.critic_sizes = (obs_dim + action_dim, *config.hidden, 1)
        self.actor_sizes = (obs_dim, *config.hidden, action_dim)
        self.split = size_of(config.critics, self.critic_sizes)  # critics, then actors
        theta = np.empty(self.split + size_of(config.actors, self.actor_sizes))
        for role, layers in zip(("critic", "actor"), self.cut(theta), strict=True):
            tied = config.init == f"tied_{role}s"
            generators = [stream(config.seed, role, 0 if tied else n)
                          for n in range(len(layers[0]))]
            first_weights(layers, generators)
        zeros = np.zeros_like(theta)
        self.set_arrays(dict(theta=theta, theta_target=theta, adam_m=zeros,
                             adam_v=zeros, updates=0))

    def cut(self, theta):
        """Views into one flat vector: (the critics' layers, the actors' layers)."""
        return (cut(theta[:self.split], self.config.critics, self.critic_sizes),
                cut(theta[self.split:], self.config.actors, self.actor_sizes))

    def act(self, obs):
        """The greedy action, without noise: (O,) → (A,) or (B, O) → (B, A)."""
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

    def td_target(self, batch):
        """y (B,) of a batch, by the config's rule. No gradient flows through it."""
        config = self.config
        return td_target(batch.reward, batch.terminated, self.q_next(batch.next_obs),
                         config.gamma, config.target_rule, config.nu, config.y_min)

    def _rows(self, array, width, name):
        array = np.atleast_2d(np.asarray(array, self.dtype))
        if array.ndim != 2 or array.shape[1] != width:
            raise ValueError(f"{name} has shape {array.shape}: expected ({width},) or "
                             f"(B, {width}).")
        return array

    def save(self, path):
        """Write weights, slow copies and Adam's moments to one `.npz`."""
        write_npz(path, config=self.config.to_json(), obs_dim=self.obs_dim,
                  action_dim=self.action_dim, **self.arrays())

    @classmethod
    def load(cls, path):
        """The agent in a file that either agent's `save` (or a Training's) wrote.

        `NumpyAgent.load` makes a NumPy agent of it, `TorchAgent.load` a PyTorch agent.
        """
        content = read_npz(path)
        try:
            config = Config.from_json(str(content["config"]))
            agent = cls(config, int(content["obs_dim"]), int(content["action_dim"]))
            agent.set_arrays(content)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no agent that this version can read: "
                             f"{error}.") from error
        return agent


class NumpyAgent(Agent):
    """The update with gradients by hand, on flat vectors and views into them."""

    def arrays(self):
        return dict(theta=self.theta, theta_target=self.theta_target,
                    adam_m=self.adam_m, adam_v=self.adam_v, updates=self.updates)

    def set_arrays(self, arrays):
        for name in ("theta", "theta_target", "adam_m", "adam_v"):
            setattr(self, name, np.array(arrays[name], self.dtype))
        self.dtheta = np.zeros_like(self.theta)
        self.updates = int(arrays["updates"])
        self.scratch = {}
        self.critic, self.actor = self.cut(self.theta)
        self.critic_target, self.actor_target = self.cut(self.theta_target)
        self.dcritic, self.dactor = self.cut(self.dtheta)

    def _act(self, obs, slow=False):
        layers = self.actor_target if slow else self.actor
        scratch = self._scratch_for(obs)
        return np.tanh(forward(layers, join(obs), scratch, f"act {slow}")[-1])

    def _q(self, obs, action, slow=False):
        """Every critic at every actor's action (K, B, A): (C, K, B)."""
        layers = self.critic_target if slow else self.critic
        pairs = [layer[:, None] for layer in layers]  # (C, 1, in + 1, out)
        scratch = self._scratch_for(obs)
        return forward(pairs, join(obs, action), scratch, f"q {slow}")[-1][..., 0]

    def _scratch_for(self, obs):
        """Memory to use again, for the two sizes that come at every step."""
        return self.scratch if len(obs) in (1, self.config.batch_size) else None

    def update(self, batch, climb=True):
        """One update: critics, then actors (if `climb`), then slow copies."""
        config, K, scratch = self.config, self.config.actors, self.scratch
        batch = Batch(*(np.asarray(part, self.dtype) for part in batch))
        size = len(batch.reward)
        self.updates += 1

        # Critics: down the mean squared error against y, summed over critics. Eq. (3)
        y = self.td_target(batch)  # (B,)
        layers = forward(self.critic, join(batch.obs, batch.action), scratch, "critic")
        error = layers[-1][..., 0] - y  # (C, B)
        backward(self.critic, layers, (2 / size) * error[..., None], self.dcritic,
                 scratch=scratch, name="dcritic")
        self._adam(slice(0, self.split), config.critic_lr)
        losses = {"critic": (error * error).sum(axis=1) / size,
                  "actor": np.full(K, np.nan)}

        # Actors: actor k up critic k, through the action a = tanh(z). Eq. (4)
        if climb:
            climbed = slice(0, K if config.climbs == "own" else 1)
            critic = [layer[climbed] for layer in self.critic]
            hidden = forward(self.actor, join(batch.obs), scratch, "actor")
            action = np.tanh(hidden[-1])  # (K, B, A)
            layers = forward(critic, join(batch.obs, action), scratch, "climb")
            dq = np.full(layers[-1].shape, -1 / size, self.dtype)  # up is minus down
            daction = backward(critic, layers, dq, inputs=slice(self.obs_dim, -1),
                               scratch=scratch, name="dclimb")
            daction *= 1 - action * action  # through tanh
            backward(self.actor, hidden, daction, self.dactor, scratch=scratch,
                     name="dactor")
            self._adam(slice(self.split, None), config.actor_lr)
            losses["actor"] = layers[-1][..., 0].sum(axis=1) / -size

        # Slow copies: a small step towards the networks that learn. Eq. (1)
        if self.updates % config.target_every == 0:
            self.theta_target += config.tau * (self.theta - self.theta_target)
        return losses

    def _adam(self, part, lr):
        adam(self.theta[part], self.dtheta[part], self.adam_m[part], self.adam_v[part],
             self.updates, lr)


class TorchAgent(Agent):
    """The same update by autograd, on `config.device`."""

    def set_arrays(self, arrays):
        import torch

        self.torch, self.updates = torch, int(arrays["updates"])
        self.critic, self.actor = self._two_parts(arrays["theta"])  # flat, they learn
        self.critic_target, self.actor_target = self._two_parts(arrays["theta_target"])
        moments = zip(self._two_parts(arrays["adam_m"]),
                      self._two_parts(arrays["adam_v"]), strict=True)
        self.optimizers = []
        for theta, lr in ((self.critic, self.config.critic_lr),
                          (self.actor, self.config.actor_lr)):
            adam = torch.optim.Adam([theta.requires_grad_()], lr=lr)
            m, v = next(moments)
            adam.state[theta] = dict(step=torch.tensor(float(self.updates)),
                                     exp_avg=m, exp_avg_sq=v)
            self.optimizers.append(adam)

    def _tensor(self, array):
        dtype = getattr(self.torch, self.config.dtype)
        return self.torch.tensor(array, dtype=dtype, device=self.config.device)

    def _two_parts(self, flat):
        return self._tensor(flat[:self.split]), self._tensor(flat[self.split:])

    def arrays(self):
        def flat(*parts):
            return self.torch.cat(parts).detach().cpu().numpy()

        critic, actor = (adam.state[theta] for adam, theta in
                         zip(self.optimizers, (self.critic, self.actor), strict=True))
        return dict(theta=flat(self.critic, self.actor),
                    theta_target=flat(self.critic_target, self.actor_target),
                    adam_m=flat(critic["exp_avg"], actor["exp_avg"]),
                    adam_v=flat(critic["exp_avg_sq"], actor["exp_avg_sq"]),
                    updates=self.updates)

    def _critics(self, flat, x):
        """x (..., B, O + A) through the critics: (..., B)."""
        layers = cut(flat, self.config.critics, self.critic_sizes)
        if x.ndim == 4:  # (1, K, B, O + A): every critic at every actor's action
            layers = [layer[:, None] for layer in layers]
        elif x.ndim == 3:  # (K, B, O + A): critic k, or the first, at actor k's
            count = len(x) if self.config.climbs == "own" else 1
            layers = [layer[:count] for layer in layers]
        return self._forward(layers, x)[..., 0]

    def _actors(self, flat, obs):
        layers = cut(flat, self.config.actors, self.actor_sizes)
        return self._forward(layers, obs).tanh()  # (K, B, A)

    def _forward(self, layers, x):
        for i, layer in enumerate(layers):
            x = x @ layer[..., :-1, :] + layer[..., -1:, :]  # the last row is the bias
            x = x.relu() if i < len(layers) - 1 else x
        return x

    def _act(self, obs, slow=False):
        with self.torch.no_grad():
            flat = self.actor_target if slow else self.actor
            return self._actors(flat, self._tensor(obs)).cpu().numpy()

    def _q(self, obs, action, slow=False):
        with self.torch.no_grad():
            flat = self.critic_target if slow else self.critic
            x = self._tensor(join(obs, action)[None, ..., :-1])
            return self._critics(flat, x).cpu().numpy()  # (C, K, B)

    def update(self, batch, climb=True):
        """One update: critics, then actors (if `climb`), then slow copies."""
        torch, config, K = self.torch, self.config, self.config.actors
        batch = Batch(*(np.asarray(part, self.dtype) for part in batch))
        obs, action = self._tensor(batch.obs), self._tensor(batch.action)
        self.updates += 1

        # Critics: down the mean squared error against y, summed over critics. Eq. (3)
        y = self._tensor(self.td_target(batch))  # (B,)
        q = self._critics(self.critic, torch.cat((obs, action), dim=1))  # (C, B)
        critic_loss = (q - y).square().mean(dim=1)  # (C,)
        self._descend(self.optimizers[0], critic_loss.sum(), self.critic)
        losses = {"critic": critic_loss, "actor": torch.full((K,), torch.nan)}

        # Actors: actor k up critic k, through the action. Eq. (4)
        if climb:
            action = self._actors(self.actor, obs)  # (K, B, A)
            x = torch.cat((obs.expand(K, *obs.shape), action), dim=2)
            actor_loss = -self._critics(self.critic, x).mean(dim=1)  # (K,)
            self._descend(self.optimizers[1], actor_loss.sum(), self.actor)
            losses["actor"] = actor_loss

        # Slow copies: a small step towards the networks that learn. Eq. (1)
        if self.updates % config.target_every == 0:
            with torch.no_grad():
                self.critic_target.lerp_(self.critic, config.tau)
                self.actor_target.lerp_(self.actor, config.tau)
        return {name: loss.detach().cpu().numpy() for name, loss in losses.items()}

    def _descend(self, optimizer, loss, theta):
        """One step of Adam on theta; no gradient is kept for anyone else's weights."""
        (theta.grad,) = self.torch.autograd.grad(loss, theta)
        optimizer.step()


def make_agent(config, obs_dim, action_dim):
    """The agent that `config.backend` names."""
    kind = TorchAgent if config.backend == "torch" else NumpyAgent
    return kind(config, obs_dim, action_dim)


# --- 7. The task ----------------------------------------------------------------------


def to_env(action, space):
    """[-1, 1] → the units of the task's action space, (A,) or (B, A).

    The one place where this happens. Bounds may differ by dimension.
    """
    middle, half = (space.high + space.low) / 2, (space.high - space.low) / 2
    return np.minimum(np.maximum(middle + half * action, space.low), space.high)


def make_env(config, render_mode=None):
    """Make `config.task`, or refuse it with a ValueError that says why."""
    named = f"task={config.task!r}"
    try:
        if "mujoco" in str(gym.spec(config.task).entry_point):
            _quiet_mujoco()
        env = gym.make(config.task, max_episode_steps=config.max_episode_steps,
                       disable_env_checker=True, render_mode=render_mode,
                       **config.task_options)
    except gym.error.DependencyNotInstalled as error:
        raise ValueError(f"{named} needs a package that is missing: {error}") from error
    except gym.error.Error as error:
        near = difflib.get_close_matches(config.task, gym.registry, n=3, cutoff=0.5)
        hint = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
        raise ValueError(f"{named} is unknown to Gymnasium.{hint}") from error
    except TypeError as error:
        raise ValueError(f"{named} refuses task_options={config.task_options!r}: "
                         f"{error}") from error
    for name in ("observation_space", "action_space"):
        space = getattr(env, name)
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"{named} has {name} {space}: expected a flat Box of "
                             "numbers (continuous, one axis).")
    if not env.action_space.is_bounded():
        raise ValueError(f"{named} has unbounded actions {env.action_space}: expected "
                         "finite bounds, since actors end in tanh.")
    return env


def _quiet_mujoco():
    """Keep MuJoCo's note on 'settotalmass' (Humanoid, harmless) off the screen."""
    import mujoco

    mujoco.set_mju_user_warning(lambda text: "settotalmass" in str(text)
                                or warnings.warn(str(text), stacklevel=2))


def simulator_state(env):
    """The task's whole state as arrays: (state (S,), MuJoCo's xipos (bodies, 3)).

    `xipos` lags one step behind in MuJoCo, and Humanoid's reward reads it, so it must
    be kept too. Both are empty for a task that shows no state.
    """
    inner = env.unwrapped
    if not (hasattr(inner, "model") and hasattr(inner, "data")):
        return np.array(getattr(inner, "state", ()), float).ravel(), np.empty((0, 3))
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
    losses are means over its updates, NaN if there were none.
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


class Training:
    """One run, as an iterator of `Record`s. It learns; its caller shows and measures.

        training = Training(Config("Pendulum-v1", "DDPG", seed=0))
        for record in training:
            ...                     # training.agent may be measured here

    `save(path)` writes the state at the last episode's end, and `Training.load(path)`
    goes on from there with the same numbers, bit for bit, as if never stopped.
    """

    def __init__(self, config):
        self.config = config
        self.env = make_env(config)
        obs_dim = self.env.observation_space.shape[0]
        self.action_dim = self.env.action_space.shape[0]
        self.agent = make_agent(config, obs_dim, self.action_dim)
        self.streams = {role: stream(config.seed, role) for role in
                        ("replay", "noise", "warmup", "environment", "keep")}
        self.replay = ReplayBuffer(config.buffer_size, obs_dim, self.action_dim,
                                   self.streams["replay"])
        self.noise = Noise(config, self.action_dim, self.streams["noise"])
        self.step = self.episode = 0
        self.keep_at = int(self.streams["keep"].integers(KEEP_EVERY))
        self.records, self.kept, self.first_losses = [], [], []
        self._threads = ThreadpoolController()
        self._remember()
        self._loop = self._run()

    @property
    def updates(self):
        return self.agent.updates

    @property
    def finished(self):
        """True when the run's last step, or its last episode, is done."""
        if self.config.episodes is None:
            return self.step >= self.config.steps
        return self.episode >= self.config.episodes

    def __iter__(self):
        return self

    def __next__(self) -> Record:
        with self._threads.limit(limits=1):  # one run, one thread
            return next(self._loop)

    def _run(self):
        while not self.finished:
            seed = int(self.streams["environment"].integers(2**31))
            obs, _ = self.env.reset(seed=seed)
            self.noise.reset()
            total, length, over = 0.0, 0, False
            self._losses = {"critic": 0.0, "actor": 0.0, "updates": 0}
            while not (over or self.finished):
                obs, reward, over = self._step(obs)
                total, length = total + reward, length + 1
                if self.step % self.config.evaluate_every == 0:
                    yield self._record("grid", total, length)
                elif self.step % self.config.yield_every == 0:
                    yield self._record("progress", total, length)
            record = self._record("episode" if over else "progress", total, length)
            self.episode += over
            self.noise.scale *= self.noise.decay
            self._remember()
            yield record

    def _step(self, obs):
        """One step of the environment, then the updates. → next obs, reward, over."""
        config = self.config
        action = self._explore(obs)
        if self.step == self.keep_at:
            self._keep(obs, action)
        self.step += 1
        next_obs, reward, terminated, truncated, _ = self.env.step(
            to_env(action, self.env.action_space))
        if not (math.isfinite(reward) and np.isfinite(next_obs).all()):
            raise ValueError(f"step {self.step} of {config.task!r}: reward {reward!r}, "
                             f"observation {next_obs!r}: expected finite numbers.")
        over = bool(terminated or truncated)
        end = {"terminated": terminated, "none": False, "any_end": over}[config.ends]
        self._store(obs, action, reward, next_obs, end)
        if self.step > config.warmup:
            frozen = config.freeze_actors_after
            climb = frozen is None or self.step <= frozen
            for _ in range(config.updates_per_step):
                batch = self.replay.sample(config.batch_size)
                self._note(self.agent.update(batch, climb=climb))
        return next_obs, float(reward), over

    def _explore(self, obs):
        """The action to execute, (A,): uniform at first, then greedy + noise."""
        if self.step < self.config.warmup:
            return self.streams["warmup"].uniform(-1, 1, self.action_dim)
        action = self.agent.act(obs) + self.noise.sample()
        return np.minimum(np.maximum(action, -1), 1)

    def _store(self, *transition):
        """Into replay. A row that makes room is noted until the episode's end."""
        replay, row = self.replay, self.replay.position
        if replay.size == replay.capacity:
            self._overwritten.append((row, [old[row].copy() for old in replay.arrays]))
        replay.add(*transition)

    def _keep(self, obs, action):
        """Keep the simulator's state before a step that was drawn beforehand."""
        state, xipos = simulator_state(self.env)
        kept = dict(step=self.step, state=state, xipos=xipos,
                    obs=np.array(obs, np.float32), action=np.array(action, np.float32))
        self.kept = [*self.kept, kept][-KEPT:]
        next_window = (self.step // KEEP_EVERY + 1) * KEEP_EVERY
        self.keep_at = next_window + int(self.streams["keep"].integers(KEEP_EVERY))

    def _note(self, losses):
        self._losses["updates"] += 1
        for name, loss in losses.items():
            self._losses[name] = self._losses[name] + loss
        if len(self.first_losses) < FIRST_LOSSES:
            self.first_losses = [*self.first_losses, losses["critic"]]

    def _record(self, kind, total, length):
        updates = self._losses["updates"] or math.nan
        losses = (np.full(count, self._losses[name] / updates, float)
                  for name, count in (("critic", self.config.critics),
                                      ("actor", self.config.actors)))
        record = Record(kind, self.step, self.updates, self.episode, total, length,
                        *losses)
        if kind != "progress":
            self.records.append(record)
        return record

    # Saving. At each episode's end the small things are copied. The replay memory is
    # not: the rows overwritten since are noted, and put back in what is saved.

    def _remember(self):
        self._overwritten = []
        self._notes = dict(
            step=self.step, episode=self.episode, keep_at=self.keep_at, kept=self.kept,
            noise_scale=self.noise.scale, size=self.replay.size,
            position=self.replay.position, records=len(self.records),
            first_losses=self.first_losses,
            streams={role: rng.bit_generator.state
                     for role, rng in self.streams.items()})
        self._weights = {name: np.copy(array)
                         for name, array in self.agent.arrays().items()}

    def save(self, path):
        """Write the state at the last episode's end to one `.npz`, whole or not at all.

        At the end of the run it is the state then, even in the middle of an episode.
        """
        notes, replay = self._notes, {}
        for i, name in enumerate(Batch._fields):
            replay[name] = self.replay.arrays[i][:notes["size"]].copy()
            for row, old in reversed(self._overwritten):
                replay[name][row] = old[i]
        notes = notes | dict(records=self.records[:notes["records"]])
        write_npz(path, config=self.config.to_json(), obs_dim=self.agent.obs_dim,
                  action_dim=self.action_dim, **self._weights, **replay,
                  notes=json.dumps(notes, default=np.ndarray.tolist))

    @classmethod
    def load(cls, path):
        """A Training that goes on where the file was written. ValueError if damaged."""
        content = read_npz(path)
        try:
            training = cls(Config.from_json(str(content["config"])))
            training._restore(content, json.loads(str(content["notes"])))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no training that this version can resume: "
                             f"{error}.") from error
        return training

    def _restore(self, content, notes):
        self.agent.set_arrays(content)
        for name in ("step", "episode", "keep_at"):
            setattr(self, name, notes[name])
        for role, state in notes["streams"].items():
            self.streams[role].bit_generator.state = state
        self.noise.scale = notes["noise_scale"]
        self.replay.size, self.replay.position = notes["size"], notes["position"]
        for name, array in zip(Batch._fields, self.replay.arrays, strict=True):
            array[:notes["size"]] = content[name]
        self.records = [Record(*record[:6], *map(np.array, record[6:]))
                        for record in notes["records"]]
        self.first_losses = [np.array(loss, self.agent.dtype)
                             for loss in notes["first_losses"]]
        kinds = dict(step=int, state=np.array, obs=np.float32, action=np.float32,
                     xipos=lambda rows: np.reshape(rows, (-1, 3)))
        self.kept = [{name: kinds[name](value) for name, value in kept.items()}
                     for kept in notes["kept"]]
        self._remember()
