"""Agents that are wrong on purpose: chapter 03's ablations, chapter 12's silent bugs.

None of them raises an error. Where one field of `Config` makes the fault, it is listed
as such; the others are small subclasses, and what differs from the right code is all
that a subclass holds.

| name | what is wrong | how |
|---|---|---|
| `no_replay` | learns from the newest batch of transitions only | `buffer_size` |
| `no_slow_copy` | y comes from the networks that learn | `tau=1` |
| `no_noise` | no exploration after the warm-up | `sigma=0` |
| `time_limit` | the time limit is stored as an end | `ends="any_end"` |
| `one_seed` | every episode starts from one seed | `OneSeed` |
| `lost_axis` | (B,) meets (B, 1) in the critic's loss | `LostAxis` |
| `env_units` | the action is stored in the task's units, not scaled back | `EnvUnits` |
| `through_y` | the gradient flows through y as well | `ThroughY` |
| `no_end` | real ends are ignored (on MountainCar) | `ends="none"` |
"""

import gymnasium as gym
import numpy as np

from dnddpg_minimal.dnddpg import (
    NumpyAgent,
    Training,
    backward,
    forward,
    join,
    td_target,
    to_env,
)


class OneSeed(Training):
    """Every episode is `reset(seed=config.seed)`: the same start, again and again."""

    def __init__(self, config):
        super().__init__(config)
        self.env = _SameReset(self.env, config.seed)


class _SameReset(gym.Wrapper):
    def __init__(self, env, seed):
        super().__init__(env)
        self.seed = seed

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=self.seed, options=options)


class EnvUnits(Training):
    """Replay holds the action in the task's units; the actor still asks in [-1, 1].

    On Pendulum a stored action of 2 is what the actor calls 1. The critic learns the
    value of a policy with half the torque; the policy that acts has all of it.
    """

    def _store(self, obs, action, *rest):
        super()._store(obs, to_env(action, self.env.action_space), *rest)


class _OtherAgent(Training):
    """A Training with another agent, which knows DDPG only.

    Another config is refused with a ValueError.
    """

    def __init__(self, config):
        if (config.critics, config.actors) != (1, 1):
            raise ValueError("This faulty agent is written for DDPG; got "
                             f"{config.algorithm!r}.")
        super().__init__(config)


class LostAxisAgent(NumpyAgent):
    """q (B, 1) minus y (B,) is (B, B): every q meets every y of the batch.

    The mean of (q_i - y_j)² over i and j has the gradient of (q_i - mean(y))², and is
    larger by the variance of y. So both are written that way, without the big array.
    """

    def td_target(self, batch):
        """The mean of y over the batch, B times, (B,): what each q is drawn to."""
        y = super().td_target(batch)
        self.variance = y.var()
        return np.full_like(y, y.mean())

    def update(self, batch, climb=True):
        """As `Agent.update`; the critic's loss is larger by the variance of y."""
        losses = super().update(batch, climb)
        losses["critic"] = losses["critic"] + self.variance
        return losses


class LostAxis(_OtherAgent):
    """Trains `LostAxisAgent`. ValueError for anything but DDPG in NumPy."""

    agent_class = LostAxisAgent


class ThroughYAgent(NumpyAgent):
    """y comes from the networks that learn, and its gradient is not cut.

    The gradient of mean (q - y)² is then 2/B · sum of (q - y) (∇q - ∇y), where
    ∇y = γ (1 - terminated) ∇q(s', μ(s')): the critic may also pull y towards q.
    This is Baird's residual gradient (1995), met by accident.
    """

    def td_target(self, batch):
        """y (B,) of a batch from the networks that learn, not from slow copies."""
        self.batch = batch
        q_next = self._q(batch.next_obs, self._act(batch.next_obs))  # (1, 1, B)
        return td_target(batch.reward, batch.terminated, q_next, self.config.gamma)

    def _adam(self, part, t, lr):
        if part.start == 0:  # the critic's step, not the actor's
            self.dtheta += self.gradient_through_y()
        super()._adam(part, t, lr)

    def gradient_through_y(self):
        """The part that should not be there: a flat vector (weights,), like theta."""
        batch, extra = self.batch, np.zeros_like(self.theta)
        y = self.td_target(batch)
        error = self._q(batch.obs, batch.action[None])[0, 0] - y  # (B,)
        action = self._act(batch.next_obs)[0]  # (B, A)
        layers = forward(self.critic, join(batch.next_obs, action))
        dq = -2 / len(y) * error * self.config.gamma * (1 - batch.terminated)  # (B,)
        backward(self.critic, layers, dq[None, :, None], self.cut(extra)[0])
        return extra


class ThroughY(_OtherAgent):
    """Trains `ThroughYAgent`. ValueError for anything but DDPG in NumPy."""

    agent_class = ThroughYAgent


# name: the fields of Config that differ
ABLATIONS = {
    "no_replay": dict(buffer_size=64),  # the batch size of Pendulum's preset
    "no_slow_copy": dict(tau=1.0),
    "no_noise": dict(sigma=0.0),
}
# name: task, the fields of Config that differ, the class that trains
BUGS = {
    "time_limit": ("Pendulum-v1", dict(ends="any_end"), Training),
    "one_seed": ("Pendulum-v1", {}, OneSeed),
    "lost_axis": ("Pendulum-v1", {}, LostAxis),
    "env_units": ("Pendulum-v1", {}, EnvUnits),
    "through_y": ("Pendulum-v1", {}, ThroughY),
    "no_end": ("MountainCarContinuous-v0", dict(ends="none"), Training),
}
