"""Probes: tiny tasks whose true Q is one line, so that an instrument can be tested.

Who measures the error of a critic needs a task where the truth is known without any
measurement. Each probe isolates one thing that an agent may get wrong:

| class | reward | ends | true Q(s, a) | what it catches |
|---|---|---|---|---|
| `ConstantReward` | 1, always | never | 1 / (1-g) | a time limit taken for an end |
| `RealEnd` | 1, always | after 5 steps | (1-g^k) / (1-g), k left | an end passed over |
| `ObservedReward` | the observation | never | s + g/2 / (1-g) | a critic blind to s |
| `TwoSteps` | 1-(a-1/2)^2, late | after 2 steps | g (1-(a-1/2)^2) | wrong discounting |
| `LinearQuadratic` | a quadratic cost | never | -(cost + g x'Px) | a wrong slope in a |

Here g is gamma. "Never" means: only the time limit of the registration (50 steps),
which is no end of the world. The tasks are registered with "-v0" behind the name.

| call | shape | meaning |
|---|---|---|
| `start_states(rng, n)` | (N, S) | how an episode begins |
| `observe(states)` | (N, S) -> (N, O) float32 | what the agent sees |
| `dynamics(states, actions, rng)` | (N, S), (N, 1) -> ... | one step of N copies |
| `true_q(obs, action, gamma, gain)` | (B, O), (B, 1) -> (B,) | the closed form |

All four are static, and the environments call the first three with N = 1. `gain` is
the policy's, a = gain s, and matters for `LinearQuadratic` only: elsewhere Q either
does not depend on the policy, or not after the action that is asked about. `rng` draws
what is left to chance. A gamma outside [0, 1) is refused with a ValueError.
"""

import gymnasium as gym
import numpy as np


class Probe(gym.Env):
    """What the probes share: one action in [-1, 1], and a step made from `dynamics`.

    A subclass gives the four static functions of the module's table, and the largest
    and smallest observations, `low` and `high`. There are no pictures: ValueError for a
    `render_mode` other than None.
    """

    metadata = {"render_modes": []}
    low = (0.0,)
    high = (1.0,)

    def __init__(self, render_mode=None):
        if render_mode is not None:
            raise ValueError(
                f"render_mode={render_mode!r} is not possible: a probe has no picture, "
                "allowed is None"
            )
        self.render_mode = None
        low, high = np.array(self.low, np.float32), np.array(self.high, np.float32)
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._states = None  # (1, S), or None before the first reset

    @property
    def state(self):
        """The state, (S,) float64: all that the future depends on.

        It can be set. ValueError for anything but S finite numbers.
        """
        self._check_started()
        return self._states[0].copy()

    @state.setter
    def state(self, value):
        value = np.array(value, np.float64)
        size = self.start_states(np.random.default_rng(0), 1).shape[1]
        if value.shape != (size,) or not np.all(np.isfinite(value)):
            raise ValueError(f"state: expected {size} finite numbers, got {value}")
        self._states = value[None]

    def reset(self, *, seed=None, options=None):
        """Begin an episode → obs (O,), {}. `seed` as in Gymnasium; no `options`."""
        super().reset(seed=seed)
        self._states = self.start_states(self.np_random, 1)
        return self.observe(self._states)[0], {}

    def step(self, action):
        """One step with action (1,) → obs (O,), reward, terminated, False, {}."""
        self._check_started()
        actions = np.asarray(action, np.float64).reshape(1, 1)
        self._states, rewards, terminated = self.dynamics(
            self._states, actions, self.np_random
        )
        obs = self.observe(self._states)[0]
        return obs, float(rewards[0]), bool(terminated[0]), False, {}

    def _check_started(self):
        if self._states is None:
            raise gym.error.ResetNeeded(f"{type(self).__name__}: call reset() first")


class ConstantReward(Probe):
    """Reward 1 in every step, for ever. Nothing to see, nothing to do.

    Q = 1 + gamma + gamma^2 + ... = 1 / (1 - gamma), a geometric series. An agent that
    stores the time limit as an end learns less: it believes that the sum stops.
    """

    @staticmethod
    def start_states(rng, n):
        """n starts (n, 1), all in the one state, 0."""
        return np.zeros((n, 1))

    @staticmethod
    def observe(states):
        """What the agent sees: states (N, S) → obs (N, O) float32."""
        return states.astype(np.float32)

    @staticmethod
    def dynamics(states, actions, rng=None):
        """states, actions (N, 1) -> next_states (N, 1), rewards, terminated (N,)."""
        n = len(states)
        return states.copy(), np.ones(n), np.zeros(n, bool)

    @staticmethod
    def true_q(obs, action, gamma, gain=None):
        """1 / (1 - gamma) everywhere: obs (B, 1), action (B, 1) -> (B,)."""
        _check_gamma(gamma)
        return np.full(len(obs), 1.0 / (1.0 - gamma))


class RealEnd(Probe):
    """Reward 1 in every step, and after 5 steps the world really ends.

    The observation is the share of steps that are left, k / 5, since otherwise Q would
    not be a function of what the agent sees. With k rewards to come,
    Q = 1 + gamma + ... + gamma^(k-1) = (1 - gamma^k) / (1 - gamma); after the end 0.
    An agent that bootstraps through the end learns too much.
    """

    length = 5  # steps

    @staticmethod
    def start_states(rng, n):
        """n starts (n, 1): all steps are left."""
        return np.full((n, 1), float(RealEnd.length))

    @staticmethod
    def observe(states):
        """What the agent sees: states (N, S) → obs (N, O) float32."""
        return (states / RealEnd.length).astype(np.float32)

    @staticmethod
    def dynamics(states, actions, rng=None):
        """states, actions (N, 1) -> next_states (N, 1), rewards, terminated (N,)."""
        next_states = states - 1.0
        return next_states, np.ones(len(states)), next_states[:, 0] <= 0.0

    @staticmethod
    def true_q(obs, action, gamma, gain=None):
        """(1 - gamma^k) / (1 - gamma), k steps left: obs (B, 1), any action -> (B,)."""
        _check_gamma(gamma)
        k = np.rint(np.asarray(obs, np.float64)[:, 0] * RealEnd.length)
        return (1.0 - gamma**k) / (1.0 - gamma)


class ObservedReward(Probe):
    """The reward is the observation, and each observation is drawn afresh from [0, 1].

    The reward of this step is seen, s; every later one is 1/2 on average, whatever is
    done. So Q = s + gamma/2 + gamma^2/2 + ... = s + gamma / (2 (1 - gamma)).
    It is the one probe with chance in it: a rollout scatters around the truth.
    """

    @staticmethod
    def start_states(rng, n):
        """n starts (n, 1), drawn by rng uniformly from [0, 1]."""
        return rng.random((n, 1))

    @staticmethod
    def observe(states):
        """What the agent sees: states (N, S) → obs (N, O) float32."""
        return states.astype(np.float32)

    @staticmethod
    def dynamics(states, actions, rng):
        """states, actions (N, 1) -> next_states (N, 1), rewards, terminated (N,)."""
        n = len(states)
        return rng.random((n, 1)), states[:, 0].copy(), np.zeros(n, bool)

    @staticmethod
    def true_q(obs, action, gamma, gain=None):
        """obs + gamma / (2 (1 - gamma)): obs (B, 1), any action -> (B,)."""
        _check_gamma(gamma)
        return np.asarray(obs, np.float64)[:, 0] + gamma * 0.5 / (1.0 - gamma)


class TwoSteps(Probe):
    """The first action is paid for in the second step, which is the last.

    Reward 0 in the first step and 1 - (a - 1/2)^2 in the second, with a the *first*
    action; the second action does nothing. So Q = gamma (1 - (a - 1/2)^2) at the start:
    discounting is visible as the factor gamma, and the best first action is 1/2.
    One step later Q = 1 - (a - 1/2)^2 with the a that is kept in the observation;
    after the end 0.
    The observation is (steps taken / 2, the first action or 0).
    """

    low = (0.0, -1.0)
    high = (1.0, 1.0)

    @staticmethod
    def start_states(rng, n):
        """n starts (n, 2): (steps taken, first action) = (0, 0)."""
        return np.zeros((n, 2))

    @staticmethod
    def observe(states):
        """What the agent sees: states (N, S) → obs (N, O) float32."""
        return (states / (2.0, 1.0)).astype(np.float32)

    @staticmethod
    def dynamics(states, actions, rng=None):
        """One step of N copies: states (N, 2), actions (N, 1).

        Returns next_states (N, 2), rewards (N,), terminated (N,) bool.
        """
        first = states[:, 0] == 0.0
        next_states = states.copy()
        next_states[:, 0] += 1.0
        next_states[first, 1] = np.clip(actions[first, 0], -1.0, 1.0)
        rewards = np.where(first, 0.0, TwoSteps.payment(states[:, 1]))
        return next_states, rewards, ~first

    @staticmethod
    def payment(first_action):
        """What the first action a earns, 1 - (a - 1/2)^2: (B,) -> (B,)."""
        return 1.0 - (first_action - 0.5) ** 2

    @staticmethod
    def true_q(obs, action, gamma, gain=None):
        """gamma payment(a) at the start, payment(kept) one step later, then 0.

        obs (B, 2), action a (B, 1) -> (B,).
        """
        _check_gamma(gamma)
        obs, action = np.asarray(obs, np.float64), np.asarray(action, np.float64)
        taken = np.rint(obs[:, 0] * 2.0)
        now = gamma * TwoSteps.payment(action[:, 0])
        later = TwoSteps.payment(obs[:, 1])
        return np.select([taken == 0.0, taken == 1.0], [now, later], 0.0)


class LinearQuadratic(Probe):
    """A cart with friction on a slope that leads back to 0; its cost is a quadratic.

    x' = A x + B a with x = (position, velocity), reward = -(x' C x + R a^2), of the
    state and the action *before* the step. It never ends.

    Under a policy a = K x the next state is (A + B K) x, so each later state is linear
    in x and the sum of all discounted costs is a quadratic form x' P x. One step back
    (Bellman) gives the equation for P, Lyapunov's with a discount:
        P = C + K' R K + gamma (A + B K)' P (A + B K)
    and Q(x, a) = -(x' C x + R a^2 + gamma (A x + B a)' P (A x + B a)), for any a.
    The best K follows from the best P, see `riccati`. It holds without the limits of
    the action, so the starts are chosen such that the best K keeps |a| <= 0.8.
    """

    A = np.array([[0.9, 0.3], [0.0, 0.7]])
    B = np.array([[0.0], [0.3]])
    C = np.array([[1.0, 0.0], [0.0, 0.1]])  # cost of the state
    R = np.array([[0.5]])  # cost of the action
    start = (0.7, 0.4)  # largest |position| and |velocity| at the start
    # With |a| <= 1 the velocity stays within 0.3 / (1 - 0.7) = 1, and so the position
    # within 0.3 * 1 / (1 - 0.9) = 3
    low = (-3.0, -1.0)
    high = (3.0, 1.0)

    @staticmethod
    def start_states(rng, n):
        """n starts (n, 2), drawn by rng uniformly from the box of `start`."""
        start = np.array(LinearQuadratic.start)
        return rng.uniform(-start, start, (n, 2))

    @staticmethod
    def observe(states):
        """What the agent sees: states (N, S) → obs (N, O) float32."""
        return states.astype(np.float32)

    @staticmethod
    def dynamics(states, actions, rng=None):
        """One step of N copies: states (N, 2), actions (N, 1).

        Returns next_states (N, 2), rewards (N,), terminated (N,) bool.
        """
        actions = np.clip(actions, -1.0, 1.0)
        cost = LinearQuadratic.cost(states, actions)
        return LinearQuadratic.move(states, actions), -cost, np.zeros(len(states), bool)

    @staticmethod
    def move(states, actions):
        """A x + B a for each row: states x (N, 2), actions a (N, 1) -> (N, 2)."""
        return states @ LinearQuadratic.A.T + actions @ LinearQuadratic.B.T

    @staticmethod
    def cost(states, actions):
        """x' C x + R a^2 for each row: states x (N, 2), actions a (N, 1) -> (N,)."""
        return _quadratic(states, LinearQuadratic.C) + _quadratic(
            actions, LinearQuadratic.R
        )

    @staticmethod
    def true_q(obs, action, gamma, gain=None):
        """-(cost + gamma x' P x of the next state): obs (B, 2), action (B, 1) -> (B,).

        gain: (1, 2), the policy a = gain x from the next step on, unclipped; None is
        the best policy. Raises ValueError where the gain lets the sum grow for ever.
        """
        obs, action = np.asarray(obs, np.float64), np.asarray(action, np.float64)
        if gain is None:
            _, P = riccati(gamma)
        else:
            P = lyapunov(gain, gamma)
        after = LinearQuadratic.move(obs, action)
        return -(LinearQuadratic.cost(obs, action) + gamma * _quadratic(after, P))


def riccati(gamma):
    """The best policy of `LinearQuadratic` and its cost: gain (1, 2) and P (2, 2).

    Value iteration on quadratic forms. If x' P x is the cost from the next state on,
    then cost(x, a) + gamma (A x + B a)' P (A x + B a) is least where its derivative
    by a is 0: at a = K x with K = -gamma (R + gamma B' P B)^-1 B' P A. Put in, that
    gives the new P. It is repeated until P stands still, and gamma < 1 makes it.
    The best action is a = gain x, the true value is -x' P x. ValueError for a gamma
    outside [0, 1).
    """
    _check_gamma(gamma)
    A, B = LinearQuadratic.A, LinearQuadratic.B
    C, R = LinearQuadratic.C, LinearQuadratic.R
    P = np.zeros_like(C)
    while True:
        gain = -gamma * np.linalg.solve(R + gamma * B.T @ P @ B, B.T @ P @ A)
        closed = A + B @ gain
        P_next = C + gain.T @ R @ gain + gamma * closed.T @ P @ closed
        if np.allclose(P_next, P, rtol=1e-13, atol=0.0):
            return gain, P_next
        P = P_next


def lyapunov(gain, gamma):
    """The cost x' P x of the policy a = gain x on `LinearQuadratic`: P, (2, 2).

    P = C + K' R K + gamma (A + B K)' P (A + B K) is linear in the four numbers of P,
    so it is solved as a system of four equations.
    gain: (1, 2). Raises ValueError for another shape, for a gamma outside [0, 1), and
    where sqrt(gamma) (A + B K) does not shrink every state: then the discounted cost is
    infinite.
    """
    _check_gamma(gamma)
    gain = np.asarray(gain, np.float64)
    if gain.shape != (1, 2):
        raise ValueError(f"gain: expected shape (1, 2), got {gain.shape}")
    closed = LinearQuadratic.A + LinearQuadratic.B @ gain
    growth = np.sqrt(gamma) * np.abs(np.linalg.eigvals(closed)).max()
    if growth >= 1.0:
        raise ValueError(
            f"gain={gain.tolist()} gives an infinite cost: sqrt(gamma) times the "
            f"largest eigenvalue of A + B K is {growth:.3f}, it must be below 1"
        )
    one_step = LinearQuadratic.C + gain.T @ LinearQuadratic.R @ gain
    # vec(M' P M) = (M' kron M') vec(P), rows of P one after the other
    system = np.eye(4) - gamma * np.kron(closed.T, closed.T)
    return np.linalg.solve(system, one_step.ravel()).reshape(2, 2)


def _quadratic(rows, matrix):
    """x' M x for each row x: (N, D), (D, D) -> (N,)."""
    return np.einsum("ni,ij,nj->n", rows, matrix, rows)


def _check_gamma(gamma):
    if not 0.0 <= gamma < 1.0:
        raise ValueError(f"gamma={gamma!r} is not possible: it must be in [0, 1)")
