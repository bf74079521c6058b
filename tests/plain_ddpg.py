"""DDPG in sixty plain lines, and a loop that trains it: an oracle for the package.

One critic, one actor, no leading axis, and none of the package's machinery but the
random streams and Adam (which has a test of its own). Lillicrap et al. 2015,
Algorithm 1. A layer's bias is the last row of its weights. Works where a time limit is
the only end.
"""

from itertools import pairwise

import gymnasium as gym
import numpy as np

from dnddpg_minimal import stream
from dnddpg_minimal.dnddpg import adam


def first_layers(rng, sizes):
    return [rng.uniform(-(n**-0.5), n**-0.5, (n + 1, m)).astype(np.float32)
            for n, m in pairwise(sizes)]


def with_ones(x):
    return np.hstack([x, np.ones((len(x), 1), np.float32)])


def forward(layers, x):
    """x (B, inputs) → what enters each layer, and the last layer's output."""
    entering = [with_ones(x)]
    for layer in layers[:-1]:
        entering.append(with_ones(np.maximum(entering[-1] @ layer, 0)))
    return entering, entering[-1] @ layers[-1]


def backward(layers, entering, dz):
    """Gradients of all layers, and of the first layer's output (before its ReLU)."""
    dlayers = []
    for layer, x in zip(layers[:0:-1], entering[:0:-1]):
        dlayers.insert(0, x.T @ dz)
        dz = (dz @ layer.T * (x > 0))[:, :-1]
    return [entering[0].T @ dz, *dlayers], dz


class PlainDDPG:
    def __init__(self, config, obs_dim, action_dim):
        self.config, self.t = config, 0
        sizes = (obs_dim + action_dim, *config.hidden, 1)
        self.critic = first_layers(stream(config.seed, "critic"), sizes)
        sizes = (obs_dim, *config.hidden, action_dim)
        self.actor = first_layers(stream(config.seed, "actor"), sizes)
        self.theta = self.critic + self.actor
        self.slow, self.m, self.v = ([factor * layer for layer in self.theta]
                                     for factor in (1, 0, 0))

    def act(self, obs):
        return np.tanh(forward(self.actor, obs)[1])

    def step(self, which, dlayers, lr):
        for n, dlayer in zip(which, dlayers):
            adam(self.theta[n], dlayer, self.m[n], self.v[n], self.t, lr)

    def update(self, obs, action, reward, next_obs):
        config, size, self.t = self.config, len(obs), self.t + 1
        layers, obs_dim = len(self.critic), obs.shape[1]
        slow_critic, slow_actor = self.slow[:layers], self.slow[layers:]
        next_action = np.tanh(forward(slow_actor, next_obs)[1])
        q_next = forward(slow_critic, np.hstack([next_obs, next_action]))[1][:, 0]
        y = reward + config.gamma * q_next
        entering, q = forward(self.critic, np.hstack([obs, action]))
        dq = 2 / size * (q - y[:, None])
        self.step(range(layers), backward(self.critic, entering, dq)[0],
                  config.critic_lr)
        entering, z = forward(self.actor, obs)
        action = np.tanh(z)
        climbed, q = forward(self.critic, np.hstack([obs, action]))
        _, dz = backward(self.critic, climbed, np.full_like(q, -1 / size))
        daction = dz @ self.critic[0][obs_dim:-1].T * (1 - action * action)
        self.step(range(layers, 2 * layers), backward(self.actor, entering, daction)[0],
                  config.actor_lr)
        for slow, layer in zip(self.slow, self.theta):
            slow += config.tau * (layer - slow)


def train(config):
    """A whole run → the agent, and every episode's return."""
    env = gym.make(config.task)
    half = env.action_space.high  # the task's bounds are symmetric
    agent = PlainDDPG(config, *env.observation_space.shape, *half.shape)
    start, warmup, noise, draw = (stream(config.seed, role) for role in
                                  ("environment", "warmup", "noise", "replay"))
    memory, returns = [], []
    while len(memory) < config.steps:
        obs, _ = env.reset(seed=int(start.integers(2**31)))
        returns.append(0.0)
        over = False
        while not over and len(memory) < config.steps:
            if len(memory) < config.warmup:
                action = warmup.uniform(-1, 1, half.shape)
            else:
                kick = config.sigma * noise.standard_normal(half.shape)
                action = np.clip(agent.act(obs[None])[0] + kick, -1, 1)
            next_obs, reward, _, over, _ = env.step(half * action)
            memory.append([np.float32(x) for x in (obs, action, reward, next_obs)])
            returns[-1] += reward
            obs = next_obs
            if len(memory) > config.warmup:
                rows = draw.integers(len(memory), size=config.batch_size)
                agent.update(*map(np.array, zip(*(memory[row] for row in rows))))
    return agent, returns
