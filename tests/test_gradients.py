"""The gradients made by hand, against two judges: differences, and PyTorch's autograd.

Both agents work in float64 here, where a true gradient agrees to nine digits or more
and a wrong one to none.
"""

import numpy as np
import pytest

from dnddpg_minimal import (
    Batch,
    Config,
    NumpyAgent,
    TorchAgent,
    read_npz,
    td_target,
    write_npz,
)
from dnddpg_minimal.dnddpg import backward, cut, forward, join

torch = pytest.importorskip("torch")
torch.set_num_threads(1)  # for networks this small, more threads only wait

OBS, ACTION, SIZES = 3, 2, (5, 6, 4, 2)  # the networks' input is obs, action


def random_networks(count=2, seed=0):
    """`count` networks side by side: one flat vector, and its layers as views."""
    weights = sum(count * (n + 1) * m for n, m in zip(SIZES, SIZES[1:]))
    flat = np.random.default_rng(seed).normal(size=weights)
    return flat, cut(flat, count, SIZES)


def random_input(size=7, seed=1):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(size, OBS)), rng.uniform(-1, 1, (size, ACTION))


def slope(function, vector, entry, h=1e-6):
    """The central difference of function() along one entry of a vector."""
    kept = vector[entry]
    vector[entry] = kept + h
    above = function()
    vector[entry] = kept - h
    below = function()
    vector[entry] = kept
    return (above - below) / (2 * h)


# --- the pieces: forward and backward -------------------------------------------------


def test_a_network_by_hand():
    """Two inputs, two hidden, one output: z = ReLU(x W + b) v + c, with small numbers.

    x = (1, 2), W = ((1, -1), (2, 0)), b = (0.5, -0.5): h = (5.5, -1.5), ReLU (5.5, 0)
    v = (2, 3), c = 1: z = 12
    """
    flat = np.array([1, -1, 2, 0, 0.5, -0.5,  # W and b: rows are inputs, then the bias
                     2, 3, 1.0])  # v and c
    layers = cut(flat, 1, (2, 2, 1))
    activations = forward(layers, join(np.array([[1.0, 2.0]])))
    assert activations[-1].tolist() == [[[12.0]]]
    dflat = np.zeros_like(flat)
    backward(layers, activations, np.ones((1, 1, 1)), cut(dflat, 1, (2, 2, 1)))
    # dv = h, dc = 1; only the first hidden unit is awake, and it passes on v = 2:
    assert dflat.tolist() == [1 * 2, 0, 2 * 2, 0, 2, 0, 5.5, 0, 1]


def test_the_last_row_of_a_layer_is_the_bias():
    _, layers = random_networks()
    obs, action = random_input()
    x = np.hstack([obs, action])
    for n in range(2):
        h = x
        for layer in layers[:-1]:
            h = np.maximum(h @ layer[n, :-1] + layer[n, -1], 0)
        z = h @ layers[-1][n, :-1] + layers[-1][n, -1]
        np.testing.assert_allclose(forward(layers, join(obs, action))[-1][n], z)


def test_networks_side_by_side_do_not_touch_each_other():
    flat, layers = random_networks()
    x = join(*random_input())
    before = forward(layers, x)[-1].copy()
    for layer in layers:
        layer[1] += 1
    after = forward(layers, x)[-1]
    np.testing.assert_array_equal(after[0], before[0])
    assert (after[1] != before[1]).all()


def test_backward_gives_every_weights_slope():
    flat, layers = random_networks()
    x = join(*random_input())
    along = np.random.default_rng(2).normal(size=(2, 7, 2))  # any direction in z

    def loss():
        return (forward(layers, x)[-1] * along).sum()

    dflat = np.zeros_like(flat)
    backward(layers, forward(layers, x), along, cut(dflat, 2, SIZES))
    slopes = [slope(loss, flat, entry) for entry in range(len(flat))]
    np.testing.assert_allclose(dflat, slopes, atol=1e-7)
    assert (dflat != 0).mean() > 0.5  # ReLU silences some, never most of them


def test_backward_gives_the_slope_along_the_action():
    """What Eq. (4) needs: dQ/da, and nothing for the observation."""
    _, layers = random_networks()
    obs, action = random_input()
    along = np.random.default_rng(2).normal(size=(2, 7, 2))

    def loss():
        return (forward(layers, join(obs, action))[-1] * along).sum()

    daction = backward(layers, forward(layers, join(obs, action)), along,
                       inputs=slice(OBS, OBS + ACTION))
    assert daction.shape == (2, 7, ACTION)
    slopes = [[slope(loss, action, (b, a)) for a in range(ACTION)] for b in range(7)]
    np.testing.assert_allclose(daction.sum(axis=0), slopes, atol=1e-7)


def test_backward_is_autograd():
    flat, layers = random_networks()
    obs, action = random_input(size=40)
    along = np.random.default_rng(2).normal(size=(2, 40, 2))
    dflat = np.zeros_like(flat)
    daction = backward(layers, forward(layers, join(obs, action)), along,
                       cut(dflat, 2, SIZES), inputs=slice(OBS, OBS + ACTION))

    theta = torch.tensor(flat, requires_grad=True)
    a = torch.tensor(action).expand(2, -1, -1).clone().requires_grad_()
    z = torch.cat([torch.tensor(obs).expand(2, -1, -1), a], dim=2)
    for i, layer in enumerate(cut(theta, 2, SIZES)):
        z = z @ layer[:, :-1] + layer[:, -1:]
        z = z.relu() if i < len(SIZES) - 2 else z
    (z * torch.tensor(along)).sum().backward()
    np.testing.assert_allclose(dflat, theta.grad, rtol=0, atol=1e-12)
    np.testing.assert_allclose(daction, a.grad, rtol=0, atol=1e-12)


# --- the gradients inside a whole update ----------------------------------------------
#
# After the first update Adam's first moment is (1 - 0.9) times the gradient, so an
# agent's own file tells which gradient it used.


def tiny_config(**choices):
    tiny = dict(hidden=(6, 5), batch_size=8, dtype="float64", target_every=2)
    return Config(**tiny | choices)


def random_batch(size=8, seed=0):
    rng = np.random.default_rng(seed)
    return Batch(rng.normal(size=(size, OBS)), rng.uniform(-1, 1, (size, ACTION)),
                 rng.normal(size=size), rng.normal(size=(size, OBS)),
                 (rng.random(size) < 0.2).astype(float))


class Bench:
    """Agents that differ in one array, made by way of their file."""

    def __init__(self, config, folder):
        self.path = folder / "agent.npz"
        NumpyAgent(config, OBS, ACTION).save(self.path)
        self.content = read_npz(self.path)
        sizes = (OBS + ACTION, *config.hidden, 1)
        self.split = sum(config.critics * (n + 1) * m for n, m in zip(sizes, sizes[1:]))

    def agent(self, theta, kind=NumpyAgent):
        write_npz(self.path, **self.content | {"theta": theta})
        return kind.load(self.path)

    def arrays(self, agent):
        agent.save(self.path)
        return read_npz(self.path)

    def slopes(self, loss, theta, directions, h=1e-5):
        """The central difference of loss(agent) along each direction."""
        return [(loss(self.agent(theta + h * d)) - loss(self.agent(theta - h * d)))
                / (2 * h) for d in directions]


def directions(count, length, part):
    """Random directions that move only a part of the weights."""
    d = np.zeros((count, length))
    d[:, part] = np.random.default_rng(7).normal(size=d[:, part].shape)
    return d


@pytest.mark.parametrize("algorithm", ["DDPG", "DCN-DDPG", "DN-DDPG"])
@pytest.mark.parametrize("kind", [NumpyAgent, TorchAgent])
def test_the_critics_gradient_is_the_slope_of_eq_3(kind, algorithm, tmp_path):
    bench = Bench(tiny_config(algorithm=algorithm), tmp_path)
    theta, batch = bench.content["theta"], random_batch()
    agent = bench.agent(theta, kind)
    y = td_target(batch.reward, batch.terminated, agent.q_next(batch.next_obs), 0.99)

    def loss(agent):
        error = agent.q_values(batch.obs, batch.action) - y
        return (error**2).mean(axis=1).sum()  # the sum over critics of means over B

    agent.update(batch)
    gradient = bench.arrays(agent)["adam_m"] / 0.1
    d = directions(10, len(theta), slice(0, bench.split))
    np.testing.assert_allclose(d @ gradient, bench.slopes(loss, theta, d), atol=1e-7)


@pytest.mark.parametrize("climbs", ["own", "first"])
@pytest.mark.parametrize("algorithm", ["DDPG", "DCN-DDPG", "DN-DDPG"])
@pytest.mark.parametrize("kind", [NumpyAgent, TorchAgent])
def test_the_actors_gradient_is_the_slope_of_eq_4(kind, algorithm, climbs, tmp_path):
    bench = Bench(tiny_config(algorithm=algorithm, climbs=climbs), tmp_path)
    theta, batch = bench.content["theta"], random_batch()
    agent = bench.agent(theta, kind)
    agent.update(batch)
    after = bench.arrays(agent)
    gradient = after["adam_m"] / 0.1

    def loss(agent):
        """Minus the climbed critic's mean Q, summed over actors."""
        actions = agent.actions(batch.obs)
        climbed = range(len(actions)) if climbs == "own" else [0] * len(actions)
        return -sum(agent.q_values(batch.obs, action)[c].mean()
                    for c, action in zip(climbed, actions))

    # the actors climb the critics that were updated, from where they stood before
    middle = np.concatenate([after["theta"][:bench.split], theta[bench.split:]])
    d = directions(10, len(theta), slice(bench.split, None))
    np.testing.assert_allclose(d @ gradient, bench.slopes(loss, middle, d), atol=1e-7)
    assert abs(d @ gradient).min() > 1e-4


# --- NumPy against PyTorch: the same weights and batches in, the same out -------------


def apart(first, second):
    """The largest difference between two agents' arrays, by name."""
    return {name: abs(first[name] - second[name]).max()
            for name in ("theta", "theta_target", "adam_m", "adam_v")}


VARIANTS = {
    "DDPG": dict(algorithm="DDPG"),
    "DCN-DDPG": dict(algorithm="DCN-DDPG"),
    "DN-DDPG": dict(algorithm="DN-DDPG"),
    "many choices": dict(critics=3, actors=2, target_rule="soft", climbs="first",
                         init="tied_actors", y_min=-0.5),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_hundred_updates_in_float64_agree_to_one_billionth(variant, tmp_path):
    bench = Bench(tiny_config(**VARIANTS[variant]), tmp_path)
    theta = bench.content["theta"]
    ours, theirs = bench.agent(theta), bench.agent(theta, TorchAgent)
    for seed in range(200):
        batch = random_batch(seed=seed)
        losses, their_losses = ours.update(batch), theirs.update(batch)
    for name in ("critic", "actor"):
        np.testing.assert_allclose(losses[name], their_losses[name], atol=1e-9, rtol=0)
    result = bench.arrays(ours)
    differences = apart(result, bench.arrays(theirs))
    assert max(differences.values()) < 1e-9, differences
    assert abs(result["theta"] - theta).max() > 0.05  # they did learn


@pytest.mark.parametrize("algorithm", ["DDPG", "DCN-DDPG", "DN-DDPG"])
def test_one_update_in_float32_agrees_to_one_millionth(algorithm, tmp_path):
    config = tiny_config(algorithm=algorithm, dtype="float32", hidden=(64, 64),
                         batch_size=64, target_every=1)
    bench = Bench(config, tmp_path)
    theta = bench.content["theta"]
    ours, theirs = bench.agent(theta), bench.agent(theta, TorchAgent)
    batch = random_batch(64)
    ours.update(batch)
    theirs.update(batch)
    result = bench.arrays(ours)
    assert result["theta"].dtype == np.float32
    differences = apart(result, bench.arrays(theirs))
    assert max(differences.values()) < 1e-6, differences


def test_both_agents_start_from_the_same_weights():
    obs, action = random_input()
    ours = NumpyAgent(tiny_config(), OBS, ACTION)
    theirs = TorchAgent(tiny_config(), OBS, ACTION)
    np.testing.assert_allclose(ours.q_values(obs, action), theirs.q_values(obs, action))
    np.testing.assert_allclose(ours.actions(obs), theirs.actions(obs))
    np.testing.assert_allclose(ours.q_next(obs), theirs.q_next(obs))


@pytest.mark.parametrize("first, second", [(NumpyAgent, TorchAgent),
                                           (TorchAgent, NumpyAgent)])
def test_a_file_of_one_agent_goes_on_as_the_other(first, second, tmp_path):
    stays = first(tiny_config(), OBS, ACTION)
    for seed in range(5):
        stays.update(random_batch(seed=seed))
    stays.save(tmp_path / "a.npz")
    changes = second.load(tmp_path / "a.npz")
    changes.save(tmp_path / "b.npz")
    a, b = read_npz(tmp_path / "a.npz"), read_npz(tmp_path / "b.npz")
    assert a.keys() == b.keys()
    for name, array in a.items():
        np.testing.assert_array_equal(b[name], array, err_msg=name)
        assert b[name].dtype == array.dtype, name
    for seed in range(5, 25):
        stays.update(random_batch(seed=seed))
        changes.update(random_batch(seed=seed))
    obs, action = random_input()
    np.testing.assert_allclose(changes.q_values(obs, action),
                               stays.q_values(obs, action), atol=1e-9)
    np.testing.assert_allclose(changes.act(obs), stays.act(obs), atol=1e-9)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_gpu_makes_the_same_update(tmp_path):
    bench = Bench(tiny_config(), tmp_path)
    ours = bench.agent(bench.content["theta"])
    theirs = TorchAgent(tiny_config(backend="torch", device="cuda"), OBS, ACTION)
    for seed in range(50):
        ours.update(random_batch(seed=seed))
        theirs.update(random_batch(seed=seed))
    differences = apart(bench.arrays(ours), bench.arrays(theirs))
    assert max(differences.values()) < 1e-9, differences
