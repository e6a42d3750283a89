# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "torch==2.13.0",
#     "gymnasium[mujoco]==1.4.0",
#     "mujoco==4.0.0",
#     "tyro==1.0.17",
#     "tensorboard==2.21.0",
#     "wandb==0.31.0",
#     "tqdm==4.70.1",
# ]
# ///
"""Genetic Policy Optimization with PPO mutation (Gangwani & Peng, ICLR 2018, https://arxiv.org/abs/1711.01012).

    python gpo_ppo.py --env-id HalfCheetah-v4 --population 8

A population of Gaussian MLP policies repeats three operators (Algorithm 1): `mutate` improves every policy with PPO and
lets similar policies share their batches; `select` picks the fittest couples; `crossover` distils each couple into a child.
Notes and results: docs/gpo.md.
"""

import ctypes
import fcntl
import io
import json
import math
import os
import signal
import socket
import sys
import time
import warnings
import zlib
from collections import deque
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

os.environ.setdefault("OMP_NUM_THREADS", "1")  # nets this small lose with threads; ranks are the parallelism
import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import tyro
from gymnasium.vector import AutoresetMode

# ---------------------------------------------------------------- flags


@dataclass
class Experiment:
    exp_name: str = Path(__file__).stem
    """the name of this experiment, part of the run's name"""
    seed: int = 1
    """the seed from which every random number of the run follows"""
    workers: int | None = None
    """processes that share the work; default: one per core this process may use, at most one per member"""
    cuda: bool = False
    """whether to compute updates on the accelerator (worker r uses device r modulo their number)"""
    run_dir: str = "runs"
    """the folder that holds the folders of all runs"""
    run_name: str | None = None
    """the name of this run's folder; default: {env_id}__{exp_name}__{seed}__{unix time}"""
    resume: str | None = None
    """the folder of a run that stopped: go on from its last checkpoint, with its flags"""
    max_restarts: int = 3
    """how often a crashed worker group is restarted from the last checkpoint (more than one worker only)"""
    track: bool = False
    """whether to send everything that is logged to Weights & Biases, too"""
    wandb_project_name: str = "gpo"
    """the project of Weights & Biases"""
    wandb_entity: str | None = None
    """the entity (team) of the Weights & Biases project"""


@dataclass
class Environment:
    env_id: str = "HalfCheetah-v4"
    """the id of any Gymnasium environment with Box observations and Box actions"""
    env_kwargs: str = "{}"
    """keyword arguments of the environment, as JSON"""
    max_episode_steps: int | None = None
    """the horizon, in steps; default: the smaller of 512 (the paper's) and the environment's own"""
    vectorization: Literal["auto", "sync"] = "auto"
    """auto: batched stepping where gpo_envs serves the id; sync: always Gymnasium's SyncVectorEnv"""
    num_envs: int = 4
    """the number of environments per member"""
    num_steps: int = 512
    """the number of steps in each environment per iteration; a member's batch is num_envs * num_steps"""


@dataclass
class Budget:
    total_timesteps: int = 8_000_000
    """environment steps of the whole population together, those of DAgger included; never exceeded"""
    population: int = 8
    """the number of policies, m in the paper"""
    rounds: int = 12
    """rounds of mutate, select and crossover; as many as fit into the budget"""


@dataclass
class Mutate:
    learning_rate: float = 3e-3
    """Adam's learning rate of the policies"""
    critic_learning_rate: float = 1e-3
    """Adam's learning rate of the critics"""
    gamma: float = 0.99
    """the discount factor"""
    gae_lambda: float = 0.95
    """the lambda of generalized advantage estimation"""
    norm_adv: bool = True
    """whether advantages are normalized to mean 0 and deviation 1 over each batch"""
    norm_obs: bool = True
    """whether observations are normalized by running statistics, which are part of the policy"""
    norm_returns: bool = True
    """whether the critic's targets are divided by a slowly moving root mean square of the returns"""
    critic_epochs: int = 10
    """passes of the critic over each batch"""
    critic_minibatch_size: int = 256
    """samples per gradient step of the critic"""


@dataclass
class PPO:
    update_epochs: int = 10
    """full-batch gradient steps of the policy per iteration"""
    kl_coef: float = 1.0
    """the initial weight of the KL penalty, beta in the paper; it adapts to kl_target"""
    kl_target: float = 0.01
    """the KL per iteration that beta aims at: doubled above 1.5 times, halved below 1/1.5 of it"""
    kl_hinge: float = 100.0
    """the weight of the additional penalty max(0, KL - 2 kl_target)^2; 0 is the paper's loss"""


@dataclass
class Sharing:
    data_sharing: bool = True
    """whether similar policies share their batches (M in the paper's ablation)"""
    kl_sharing_threshold: float = 0.5
    """policy i borrows from j if KL[i, j] was below this (nats) at the start of the round, epsilon in the paper"""
    importance_clip: float = 2.0
    """the cap of borrowed samples' importance ratios; inf is the paper's gradient"""


@dataclass
class Select:
    selection: Literal["fitness", "random"] = "fitness"
    """which couples breed: the fittest, or random ones (S in the paper's ablation)"""
    fitness: Literal["performance", "diversity", "mixture"] = "performance"
    """the fitness of a couple: sum of returns, symmetrized KL, or both as z-scores"""
    diversity_weight: float = 0.5
    """the weight of the KL in the mixture in round one; it falls linearly to 0 in the last round"""


@dataclass
class Crossover:
    crossover: Literal["state-space", "copy", "parameter"] = "state-space"
    """how two parents make a child: distillation (C in the paper's ablation), copy of the stronger, random weights"""
    crossover_pool: int = 8192
    """the most recent transitions per parent from which pi_S is learned"""
    crossover_top: float = 0.6
    """the fraction of the parents' trajectories, best first, that pi_S learns from"""
    crossover_learning_rate: float = 5e-4
    """Adam's learning rate of pi_S and of the distillation"""
    crossover_minibatch_size: int = 64
    """samples per gradient step of pi_S and of the distillation"""
    pi_s_epochs: int = 100
    """passes of pi_S over its data"""
    expert_steps: int = 5000
    """transitions of the two-headed expert pi_H per child, from ten environments"""
    student_steps: int = 500
    """transitions of the student per DAgger iteration"""
    dagger_iterations: int = 10
    """iterations of DAgger after the first fit to the expert's transitions"""
    dagger_epochs: int = 10
    """passes over the aggregated data per DAgger iteration"""
    critic_warmup: int = 2
    """iterations after a crossover that fit only the critic"""
    save_crossovers: bool = False
    """whether to keep parents and children of every round, not only of the first (crossover_001.pt)"""


@dataclass
class Evaluation:
    comparison_episodes: int = 5
    """episodes by which children are compared with their parents after each crossover; outside the budget"""
    selection_episodes: int = 20
    """episodes per member at the end that choose the best member; outside the budget"""
    report_episodes: int = 100
    """episodes per member at the end, on other seeds, that are reported; outside the budget"""


@dataclass
class Args:
    experiment: Experiment = field(default_factory=Experiment)
    environment: Environment = field(default_factory=Environment)
    budget: Budget = field(default_factory=Budget)
    mutate: Mutate = field(default_factory=Mutate)
    ppo: PPO = field(default_factory=PPO)
    sharing: Sharing = field(default_factory=Sharing)
    select: Select = field(default_factory=Select)
    crossover: Crossover = field(default_factory=Crossover)
    evaluation: Evaluation = field(default_factory=Evaluation)


def refuse(message):
    """Ends the program for bad input: one line on stderr, exit code 2."""
    print(f"{Path(__file__).name}: error: {message}", file=sys.stderr, flush=True)
    raise SystemExit(2)


def flatten(args):
    """All flags in one namespace: args.seed, not args.experiment.seed."""
    return SimpleNamespace(**{name: value for group in vars(args).values() for name, value in vars(group).items()})


def unflatten(flags):
    """The inverse of `flatten`, from a dict."""
    return Args(**{f.name: f.type(**{g.name: flags[g.name] for g in fields(f.type)}) for f in fields(Args)})


# ---------------------------------------------------------------- randomness


def rng(seed, purpose, *indices):
    """A generator of its own for each use, e.g. rng(1, "noise", round, iteration, member).

    No stream is shared, so results depend neither on the number of workers nor on what ran before a checkpoint.
    """
    return np.random.default_rng([seed, zlib.crc32(purpose.encode()), *indices])


def env_seeds(num_envs, seed, purpose, *indices):
    """One seed per environment, as a list for `envs.reset`."""
    return rng(seed, purpose, *indices).integers(2**31, size=num_envs).tolist()


# ---------------------------------------------------------------- environments

try:
    import gpo_envs  # noqa: F401  registers rllab's tasks and batched stepping
except ModuleNotFoundError as missing:
    if missing.name != "gpo_envs":
        raise
    gpo_envs = None


def make_envs(args, num_envs):
    """`num_envs` environments with SAME_STEP autoreset: batched where gpo_envs serves the id, else SyncVectorEnv.

    Under `--vectorization sync` is the place for wrappers of your own.
    """
    kwargs = json.loads(args.env_kwargs)
    if args.max_episode_steps:
        kwargs["max_episode_steps"] = args.max_episode_steps
    served = str(gym.spec(args.env_id).vector_entry_point).startswith("gpo_envs")
    with warnings.catch_warnings():
        # Gymnasium calls v4 tasks out of date and MuJoCo warns of settotalmass in its XML, once per environment.
        warnings.filterwarnings("ignore", message=".*out of date.*")
        warnings.filterwarnings("ignore", message=".*settotalmass.*")
        if served and args.vectorization == "auto":
            envs = gym.make_vec(args.env_id, num_envs, **kwargs)
        else:
            vector_kwargs = {"autoreset_mode": AutoresetMode.SAME_STEP}
            envs = gym.make_vec(args.env_id, num_envs, vectorization_mode="sync", vector_kwargs=vector_kwargs, **kwargs)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    return envs


def rollout(envs, obs, act, num_steps):
    """Steps all environments `num_steps` times with SAME_STEP autoreset.

    act(obs [envs, obs_dim], t) returns actions [envs, act_dim]; they are clipped to the Box for the environment only.
    Returns time-major arrays: obs, next_obs (the true successor, final_obs at an end), actions, rewards, terminations,
    truncations, and the next iteration's first `obs`; `diverged` [envs] marks simulations that blew up.
    """
    num_envs, obs_dim = obs.shape
    space = envs.single_action_space
    low, high = space.low.reshape(-1), space.high.reshape(-1)
    data = SimpleNamespace(
        obs=np.empty((num_steps, num_envs, obs_dim), np.float32),
        next_obs=np.empty((num_steps, num_envs, obs_dim), np.float32),
        actions=np.empty((num_steps, num_envs, low.size), np.float32),
        rewards=np.empty((num_steps, num_envs)),
        terminations=np.empty((num_steps, num_envs), bool),
        truncations=np.empty((num_steps, num_envs), bool),
        diverged=np.zeros(num_envs, bool),
    )
    for t in range(num_steps):
        data.obs[t] = obs
        data.actions[t] = actions = act(data.obs[t], t)
        actions = np.clip(actions, low, high).reshape(num_envs, *space.shape)
        obs, data.rewards[t], data.terminations[t], data.truncations[t], infos = envs.step(actions)
        obs = obs.reshape(num_envs, -1)
        data.next_obs[t] = obs
        if "final_obs" in infos:
            for e in np.flatnonzero(data.terminations[t] | data.truncations[t]):
                data.next_obs[t, e] = infos["final_obs"][e].reshape(-1)
        if "diverged" in infos:
            data.diverged |= infos["diverged"]
    data.dones = data.terminations | data.truncations
    data.last_obs = obs
    return data


def finished_episodes(open_episodes, data):
    """Cuts a roll-out at the ends of episodes. Returns per environment the episodes that ended, as (obs [L, d], return).

    open_episodes: per environment a list of [obs, return] pieces that earlier roll-outs left open; updated in place.
    """
    finished = []
    for e, pieces in enumerate(open_episodes):
        episodes, start = [], 0
        for end in np.flatnonzero(data.dones[:, e]) + 1:
            pieces.append((data.obs[start:end, e], data.rewards[start:end, e].sum()))
            episodes.append((np.concatenate([p[0] for p in pieces]), float(sum(p[1] for p in pieces))))
            pieces.clear()
            start = end
        if start < len(data.obs):
            pieces.append((data.obs[start:, e], data.rewards[start:, e].sum()))
        finished.append(episodes)
    return finished


# ---------------------------------------------------------------- networks: stacks of MLPs, one row of a flat buffer each


def policy_sizes(args):
    return (args.obs_dim, 64, 64, args.act_dim)


def critic_sizes(args):
    return (args.obs_dim, 32, 32, 1)


def make_net(flat, sizes, log_std=False, grad=None):
    """Views into a stack of MLPs and its gradient, flat [members, P].

    Per layer (W [members, out, in], b [members, out, 1]) and the same of the gradient; log_std [members, act_dim, 1];
    rows: each member as a stack of one that shares the same memory.
    """
    net = SimpleNamespace(flat=flat, grad=torch.zeros_like(flat) if grad is None else grad, layers=[], sizes=sizes)
    at = 0
    for n_in, n_out in zip(sizes, sizes[1:]):
        W = [x[:, at : at + n_out * n_in].view(-1, n_out, n_in) for x in (net.flat, net.grad)]
        at += n_out * n_in
        b = [x[:, at : at + n_out, None] for x in (net.flat, net.grad)]
        at += n_out
        net.layers.append((W[0], b[0], W[1], b[1]))
    if log_std:
        net.log_std, net.log_std_grad = (x[:, at : at + sizes[-1], None] for x in (net.flat, net.grad))
    members = range(len(flat)) if len(flat) > 1 else ()
    net.rows = [make_net(flat[i : i + 1], sizes, log_std, net.grad[i : i + 1]) for i in members] or [net]
    return net


def make_policy(flat, args):
    return make_net(flat, policy_sizes(args), log_std=True)


def init_rows(generators, sizes, output_std, log_std=False):
    """Orthogonally initialized MLPs, one row [P] per generator; log-std 0.

    P is padded to a multiple of 16: vectorized kernels then treat a member alike wherever its row stands.
    """
    count = sum(n_out * n_in + n_out for n_in, n_out in zip(sizes, sizes[1:])) + log_std * sizes[-1]
    flat = torch.zeros(len(generators), math.ceil(count / 16) * 16)
    net = make_net(flat, sizes)
    for i, generator in enumerate(generators):
        torch_generator = torch.Generator().manual_seed(int(generator.integers(2**62)))
        for W, *_ in net.layers:
            std = output_std if W is net.layers[-1][0] else math.sqrt(2)
            torch.nn.init.orthogonal_(W[i], std, generator=torch_generator)
    return flat


def forward(net, x):
    """All layers' activations [x, h1, h2, output] of a stack; x is [members, in, samples], columns are samples."""
    activations = [x]
    for W, b, *_ in net.layers[:-1]:
        # tanh(z) = 2 sigmoid(2 z) - 1; the CPU's sigmoid is several times faster than its tanh.
        h = torch.baddbmm(b, W, activations[-1], beta=2, alpha=2).sigmoid_()
        activations.append(h.mul_(2).sub_(1))
    W, b, *_ = net.layers[-1]
    activations.append(torch.baddbmm(b, W, activations[-1]))
    return activations


def backward(net, activations, grad):
    """Adds to net.grad the gradient of a loss whose derivative with respect to the output is grad [members, out, samples].

    Written out because autograd's bookkeeping costs more than these small products: dW = g h^T, db = sum g,
    and through tanh g <- W^T g * (1 - h^2).
    """
    for (W, _, W_grad, b_grad), h in zip(reversed(net.layers), reversed(activations[:-1])):
        W_grad.baddbmm_(grad, h.mT)
        b_grad.add_(grad.sum(-1, keepdim=True))
        if h is not activations[0]:
            grad = torch.ops.aten.tanh_backward(torch.bmm(W.mT, grad), h)


def adam(net, learning_rate):
    """Adam over a stack; it works element by element, so members do not mix."""
    net.flat.grad = net.grad
    return torch.optim.Adam([net.flat], lr=learning_rate, eps=1e-5, fused=True)


def fit(net, optimizer, rows, output_gradient, indices, minibatch_size):
    """Minibatch gradient descent of a stack.

    rows [members, samples, in + targets]; indices [members, steps * minibatch_size] of samples, in their order of use;
    output_gradient(output [members, out, minibatch], targets [members, targets, minibatch]) is the loss's derivative.
    """
    members, samples, width = rows.shape
    n_in = net.sizes[0]
    flat_rows = rows.reshape(members * samples, width)
    indices = indices + samples * torch.arange(members, device=rows.device)[:, None]
    for chunk in indices.split(minibatch_size, dim=1):
        batch = flat_rows.index_select(0, chunk.reshape(-1)).view(members, -1, width).mT
        net.grad.zero_()
        activations = forward(net, batch[:, :n_in])
        backward(net, activations, output_gradient(activations[-1], batch[:, n_in:]))
        optimizer.step()


def shuffles(generators, samples, epochs, device):
    """Indices [members, epochs * samples]: a new order of a member's samples for each epoch."""
    orders = [np.concatenate([g.permutation(samples) for _ in range(epochs)]) for g in generators]
    return torch.from_numpy(np.stack(orders)).to(device)


# ---------------------------------------------------------------- Gaussian policies


def gaussian_log_prob(actions, mean, log_std):
    """log pi(a|s) [members, samples]."""
    z = (actions - mean) * torch.exp(-log_std)
    return -0.5 * z.square().sum(1) - log_std.sum(1) - 0.5 * mean.shape[1] * math.log(2 * math.pi)


def gaussian_kl(mean_p, log_std_p, mean_q, log_std_q):
    """KL[p || q] of diagonal Gaussians, [members, samples]."""
    var_ratio = torch.exp(2 * (log_std_p - log_std_q))
    squares = ((mean_p - mean_q) * torch.exp(-log_std_q)).square()
    return (0.5 * (var_ratio + squares - 1) + log_std_q - log_std_p).sum(1)


def normalize(obs, stats):
    """Observations as policies see them; obs [..., members, samples, obs_dim] with statistics [members, obs_dim]."""
    return np.clip((obs - stats.mean[:, None]) * stats.inv_std[:, None], -10, 10)


def row_of(stats, i):
    """Member i's statistics, as a stack of one."""
    return SimpleNamespace(**{name: x[i : i + 1] for name, x in vars(stats).items()})


def sample_actions(policy, stats, noise):
    """act(obs, t) for `rollout`: Gaussian actions of a stack whose members own equally many environments in a row.

    noise: [steps, members, envs per member, act_dim], standard normal; None for the mean action.
    """
    members, std = len(policy.flat), policy.log_std.exp().mT.cpu().numpy()

    def act(obs, t):
        mean = policy_mean(policy, normalize(obs.reshape(members, -1, obs.shape[-1]), stats))
        return (mean if noise is None else mean + std * noise[t]).reshape(len(obs), -1)

    return act


def policy_mean(net, obs):
    """A stack's outputs [members, envs, out] for a step's normalized observations [members, envs, obs_dim]."""
    x = torch.from_numpy(obs).to(net.flat.device).mT
    if x.shape[2] == 1:  # a product with one column takes another route, whose rounding depends on the stack's size
        return forward(net, x.expand(-1, -1, 2))[-1][:, :, :1].mT.cpu().numpy()
    return forward(net, x)[-1].mT.cpu().numpy()


def normal_noise(generators, num_steps, num_envs, act_dim):
    """Standard normal numbers [steps, members, envs, act_dim], each member's from its own generator."""
    return np.stack([g.standard_normal((num_steps, num_envs, act_dim), np.float32) for g in generators], axis=1)


# ---------------------------------------------------------------- mutate


def generalized_advantages(rewards, values, next_values, terminations, dones, gamma, gae_lambda):
    """GAE (https://arxiv.org/abs/1506.02438) over time-major arrays [steps, envs].

    A termination ends the value at 0; a truncation bootstraps from next_values, the value of the final observation;
    either cuts the sum of lambda-weighted errors.
    """
    advantages = np.empty_like(values)
    deltas = rewards + gamma * np.where(terminations, 0.0, next_values) - values
    lastgaelam = np.zeros_like(values[0])
    for t in reversed(range(len(rewards))):
        advantages[t] = lastgaelam = deltas[t] + gamma * gae_lambda * ~dones[t] * lastgaelam
    return advantages


def by_member(x, members):
    """Time-major [steps, members * envs, ...] to [members, steps * envs, ...]."""
    steps, num_envs = x.shape[:2]
    x = x.reshape(steps, members, num_envs // members, *x.shape[2:]).swapaxes(0, 1)
    return np.ascontiguousarray(x).reshape(members, -1, *x.shape[3:])


def make_batches(args, data, policy, critic, stats):
    """A roll-out as one batch per member: obs [1, obs_dim, N], actions [1, act_dim, N], advantages and log_probs [1, N],
    mean and log_std of the policy that acted; and the critic's (obs [members, N, obs_dim], values, returns [members, N]).
    """
    members, device = len(policy.flat), policy.flat.device
    obs = torch.from_numpy(normalize(by_member(data.obs, members), stats)).to(device)
    next_obs = torch.from_numpy(normalize(by_member(data.next_obs, members), stats)).to(device)
    actions = torch.from_numpy(by_member(data.actions, members)).to(device).mT.contiguous()
    columns = obs.mT.contiguous()

    def values_of(x):
        values = np.concatenate([forward(critic.rows[i], x[i : i + 1])[-1][0].cpu().numpy() for i in range(members)])
        values = values.astype(np.float64) * stats.return_rms[:, None]
        return values.reshape(members, args.num_steps, -1).swapaxes(0, 1).reshape(data.rewards.shape)

    values, next_values = values_of(columns), values_of(next_obs.mT)
    advantages = generalized_advantages(
        data.rewards, values, next_values, data.terminations, data.dones, args.gamma, args.gae_lambda
    )
    values, returns, advantages = (by_member(x, members) for x in (values, values + advantages, advantages))
    if args.norm_adv:
        advantages = (advantages - advantages.mean(1, keepdims=True)) / (advantages.std(1, keepdims=True) + 1e-8)
    advantages = torch.from_numpy(advantages.astype(np.float32)).to(device)

    batches = []
    for i, row in enumerate(policy.rows):
        batch = SimpleNamespace(obs=columns[i : i + 1], actions=actions[i : i + 1], advantages=advantages[i : i + 1])
        batch.mean, batch.log_std = forward(row, batch.obs)[-1], row.log_std.clone()
        batch.log_probs = gaussian_log_prob(batch.actions, batch.mean, batch.log_std)
        batches.append(batch)
    return batches, obs, values, returns


def kl_row(own, obs, policies, args):
    """KL[pi_i, pi_j] of a member i (a stack of one) to each of policies [m, P], mean over i's observations; [m]."""
    mean, kls = forward(own, obs)[-1], []
    for j in range(len(policies)):
        other = make_policy(policies[j : j + 1], args)
        kls.append(gaussian_kl(mean, own.log_std, forward(other, obs)[-1], other.log_std).mean().item())
    return np.array(kls)


def ppo_gradient(policy, batches, kl_coef, importance_clip=math.inf):
    """Adds to policy.grad the gradient of -L^PPO with data-sharing (Section 3.2.2) of one member; returns its loss.

    batches: the member's own first, then the borrowed. For each, the mean over samples of ratio * advantage is summed,
    the ratio being pi_i over the pi_j that acted; on the member's own, kl_coef * KL[old, new] is subtracted.
    A borrowed ratio above importance_clip counts as the clip (as in V-trace, https://arxiv.org/abs/1802.01561).
    With e = a - mean and v = exp(2 log_std): d log pi / d mean = e / v and d log pi / d log_std = e^2 / v - 1.
    """
    loss, inv_var = 0.0, torch.exp(-2 * policy.log_std)
    for k, batch in enumerate(batches):
        activations = forward(policy, batch.obs)
        mean, samples = activations[-1], batch.obs.shape[2]
        ratio = torch.exp(gaussian_log_prob(batch.actions, mean, policy.log_std) - batch.log_probs)
        if k > 0:
            ratio.clamp_(max=importance_clip)
        weight = (ratio * batch.advantages / samples)[:, None]
        error = batch.actions - mean
        scaled = error * inv_var
        mean_grad = -weight * scaled
        policy.log_std_grad.sub_((weight * (scaled * error - 1)).sum(-1, keepdim=True))
        if k == 0:
            drift = mean - batch.mean
            mean_grad.add_(drift * inv_var, alpha=kl_coef / samples)
            old_var = torch.exp(2 * batch.log_std)
            kl_grad = 1 - ((old_var + drift.square()) * inv_var).mean(-1, keepdim=True)
            policy.log_std_grad.add_(kl_grad, alpha=kl_coef)
        backward(policy, activations, mean_grad)
        loss -= weight.sum().item()
    return loss


def policy_kl(policy, batch):
    """Mean KL[old, new] of one member over the states of a batch."""
    mean = forward(policy, batch.obs)[-1]
    return gaussian_kl(batch.mean, batch.log_std, mean, policy.log_std).mean().item()


def update_policies(args, policy, optimizer, batches, borrowed, kl_coefs):
    """PPO's full-batch steps for a stack, then beta's adaptation in kl_coefs. Returns losses and KLs, one per member."""
    losses, kls = [0.0] * len(batches), [0.0] * len(batches)
    for _ in range(args.update_epochs):
        policy.grad.zero_()
        for i, (row, own) in enumerate(zip(policy.rows, batches)):
            hinge = 2 * args.kl_hinge * max(0.0, kls[i] - 2 * args.kl_target)  # d/dKL of kl_hinge max(0, KL - 2 target)^2
            losses[i] = ppo_gradient(row, [own, *borrowed[i]], kl_coefs[i] + hinge, args.importance_clip)
        optimizer.step()
        kls = [policy_kl(row, own) for row, own in zip(policy.rows, batches)]
    for i, kl in enumerate(kls):
        if kl > 1.5 * args.kl_target:
            kl_coefs[i] = min(kl_coefs[i] * 2, 1e4)
        elif kl < args.kl_target / 1.5:
            kl_coefs[i] = max(kl_coefs[i] / 2, 1e-4)
    return losses, kls


def update_critics(args, critic, optimizer, obs, targets, generators):
    """Fits a stack of critics to targets [members, N] by the mean squared error."""
    rows = torch.cat([obs, torch.from_numpy(targets.astype(np.float32)).to(obs.device)[..., None]], dim=2)
    indices = shuffles(generators, obs.shape[1], args.critic_epochs, obs.device)
    fit(critic, optimizer, rows, lambda v, t: (v - t) / v.shape[2], indices, args.critic_minibatch_size)


def batch_moments(obs):
    """Count, mean and sum of squared deviations [obs_dim] of raw observations [N, obs_dim], in float64."""
    obs = obs.astype(np.float64)
    mean = obs.mean(0)
    return len(obs), mean, np.square(obs - mean).sum(0)


def update_statistics(args, population, i, moments, mean_squares):
    """Adds batches to the statistics of local member i, in the given order: observations (Chan et al.), squared returns."""
    if args.norm_obs:
        for count, mean, m2 in moments:
            total, delta = population.obs_count[i] + count, mean - population.obs_mean[i]
            population.obs_m2[i] += m2 + delta**2 * population.obs_count[i] * count / total
            population.obs_mean[i] += delta * count / total
            population.obs_count[i] = total
    if args.norm_returns:  # an average over about the last 20 iterations
        population.return_weight[i] = 0.95 * population.return_weight[i] + 1
        population.return_square[i] = 0.95 * population.return_square[i] + np.mean(mean_squares)


def statistics(population):
    """What policies and critics use of the running statistics: mean, inv_std [members, obs_dim], return_rms [members]."""
    count = np.maximum(population.obs_count, 1)[:, None]
    std = np.sqrt(np.where(population.obs_count[:, None] > 0, population.obs_m2 / count, 1.0) + 1e-8)
    square = np.where(population.return_weight > 0, population.return_square, 1.0)
    return SimpleNamespace(
        mean=population.obs_mean.astype(np.float32),
        inv_std=(1 / std).astype(np.float32),
        return_rms=np.sqrt(square / np.maximum(population.return_weight, 1) + 1e-8),
    )


# ---------------------------------------------------------------- select


def select(args, round, fitness, kl):
    """The m couples that breed (Section 3.2.3), as index pairs x < y; ties are broken by index.

    fitness [m]: mean returns, NaN for a member that must not breed; kl [m, m]: KL[i, j]. Fewer couples than m are
    used again in turn; one healthy member is paired with itself; none raises RuntimeError.
    """
    m = len(fitness)
    healthy = [i for i in range(m) if np.isfinite(fitness[i])]
    if not healthy:
        raise RuntimeError("no member of the population has a finite return")
    if len(healthy) == 1:
        return [(healthy[0], healthy[0])] * m
    couples = list(combinations(healthy, 2))
    generator = rng(args.seed, "select", round)
    if args.selection == "random":
        order = generator.permutation(len(couples))
    else:
        scores = couple_fitness(args, round, couples, fitness, kl)
        order = np.argsort(-scores, kind="stable")
    return [couples[order[k % len(couples)]] for k in range(m)]


def couple_fitness(args, round, couples, fitness, kl):
    """Performance, diversity, or their mixture as z-scores over couples, the weight of diversity annealed over rounds."""
    performance = np.array([fitness[x] + fitness[y] for x, y in couples])
    diversity = np.array([kl[x, y] + kl[y, x] for x, y in couples])
    if args.fitness != "mixture":
        return performance if args.fitness == "performance" else diversity
    weight = args.diversity_weight * (1 - round / max(args.rounds - 1, 1))
    z_performance, z_diversity = ((x - x.mean()) / (x.std() + 1e-8) for x in (performance, diversity))
    return (1 - weight) * z_performance + weight * z_diversity


# ---------------------------------------------------------------- crossover


def selector_data(args, pools, couple, stats):
    """pi_S's samples (Section 3.2.1): rows [N, obs_dim + 2] of observation, weight if from x, weight if from y.

    pools[i]: member i's recent trajectories as (obs [L, obs_dim], return). The best of both parents' together are kept.
    """
    trajectories = [(obs, ret, parent) for parent, i in enumerate(couple) for obs, ret in pools[i]]
    trajectories.sort(key=lambda trajectory: -trajectory[1])
    kept = trajectories[: max(1, int(args.crossover_top * len(trajectories)))]
    worst, best = kept[-1][1], kept[0][1]
    rows = []
    for obs, ret, parent in kept:
        row = np.zeros((len(obs), obs.shape[1] + 2), np.float32)
        row[:, :-2] = normalize(obs[None], row_of(stats, 0))[0]
        row[:, -2 + parent] = 0.1 + (ret - worst) / (best - worst) if best > worst else 1.0
        rows.append(row)
    rows = np.concatenate(rows)
    rows[:, -2:] /= rows[:, -2:].sum() / len(rows)
    return rows


def pad_rows(rows):
    """A list of [N_i, width] as one tensor [members, max N_i, width]."""
    padded = np.zeros((len(rows), max(map(len, rows)), rows[0].shape[1]), np.float32)
    for out, row in zip(padded, rows):
        out[: len(row)] = row
    return torch.from_numpy(padded)


def train_selector(args, round, slots, rows, steps, device):
    """pi_S of each couple by return-weighted maximum likelihood (Equation 1), all as one stack; outputs are logits.

    All take `steps` gradient steps, pi_s_epochs passes over the population's largest data set; a smaller one is repeated.
    """
    sizes = (args.obs_dim, 32, 32, 2)
    pi_s = make_net(init_rows([rng(args.seed, "pi_s", round, slot) for slot in slots], sizes, 0.01).to(device), sizes)

    def cross_entropy_gradient(logits, weights):
        return (torch.softmax(logits, 1) * weights.sum(1, keepdim=True) - weights) / logits.shape[2]

    samples = steps * args.crossover_minibatch_size
    indices = []
    for slot, row in zip(slots, rows):
        generator = rng(args.seed, "pi_s_shuffle", round, slot)
        epochs = math.ceil(samples / len(row))
        indices.append(shuffles([generator], len(row), epochs, device)[:, :samples])
    optimizer = adam(pi_s, args.crossover_learning_rate)
    padded = pad_rows(rows).to(device)
    fit(pi_s, optimizer, padded, cross_entropy_gradient, torch.cat(indices), args.crossover_minibatch_size)
    return pi_s


def expert_targets(pi_s, parents, obs, uniform):
    """pi_H's Gaussian per state: the parent is drawn once from pi_S, and kept. Returns (mean, log_std) in one array.

    obs [children, samples, obs_dim] normalized; uniform [children, samples] in [0, 1); parents: the stacks of x and y.
    """
    logits = policy_mean(pi_s, obs)
    # uniform < pi_S(x|s) without the exponential of a large number
    choose_x = (np.log(uniform) - np.log1p(-uniform) < logits[..., 0] - logits[..., 1])[..., None]
    targets = []
    for parent in parents:
        mean = policy_mean(parent, obs)
        targets.append(np.concatenate([mean, np.broadcast_to(parent.log_std.mT.cpu().numpy(), mean.shape)], axis=2))
    return np.where(choose_x, *targets)


def distill(args, round, slots, child, pi_s, parents, stats):
    """DAgger (Section 3.2.1, Appendix): fits a stack of children to pi_H by KL[pi_c, pi_H]; returns mean rewards per step
    of the expert and of the last student, and the final loss, one per child.
    """
    n, act_dim, device = len(slots), args.act_dim, child.flat.device
    size, optimizer = args.crossover_minibatch_size, adam(child, args.crossover_learning_rate)

    def kl_gradient(mean, targets):
        expert_mean, inv_var = targets[:, :act_dim], torch.exp(-2 * targets[:, act_dim:])
        var_ratio = torch.exp(2 * child.log_std) * inv_var
        child.log_std_grad.add_((var_ratio - 1).mean(-1, keepdim=True))
        return (mean - expert_mean) * inv_var / mean.shape[2]

    def roll(num_envs, num_steps, iteration, expert):
        envs = make_envs(args, n * num_envs)
        seeds = [s for slot in slots for s in env_seeds(num_envs, args.seed, "dagger", round, slot, iteration)]
        generators = [rng(args.seed, "dagger_noise", round, slot, iteration) for slot in slots]
        noise = normal_noise(generators, num_steps, num_envs, act_dim)
        uniform = np.stack([g.uniform(size=(num_steps, num_envs)) for g in generators], axis=1)
        targets = np.empty((num_steps, n * num_envs, 2 * act_dim), np.float32)

        def act_as_expert(obs, t):
            target = expert_targets(pi_s, parents, normalize(obs.reshape(n, num_envs, -1), stats), uniform[t])
            targets[t] = target.reshape(n * num_envs, -1)
            return (target[..., :act_dim] + np.exp(target[..., act_dim:]) * noise[t]).reshape(n * num_envs, -1)

        obs, _ = envs.reset(seed=seeds)
        act = act_as_expert if expert else sample_actions(child, stats, noise)
        data = rollout(envs, obs.reshape(n * num_envs, -1), act, num_steps)
        envs.close()
        obs = normalize(by_member(data.obs, n), stats)
        if expert:
            labels = by_member(targets, n)
        else:
            labels = expert_targets(pi_s, parents, obs, uniform.swapaxes(0, 1).reshape(n, -1))
        rows = torch.from_numpy(np.concatenate([obs, labels], axis=2).astype(np.float32)).to(device)
        return rows, by_member(data.rewards, n).mean(1)

    rows, expert_reward = roll(10, args.expert_steps // 10, 0, expert=True)
    student_reward = expert_reward
    for iteration in range(args.dagger_iterations + 1):
        if iteration > 0:
            student_rows, student_reward = roll(1, args.student_steps, iteration, expert=False)
            rows = torch.cat([rows, student_rows], dim=1)
        generators = [rng(args.seed, "dagger_shuffle", round, slot, iteration) for slot in slots]
        indices = shuffles(generators, rows.shape[1], args.dagger_epochs, device)
        fit(child, optimizer, rows, kl_gradient, indices, size)

    obs, targets = rows[..., : args.obs_dim].mT, rows[..., args.obs_dim :].mT
    mean = forward(child, obs)[-1]
    loss = gaussian_kl(mean, child.log_std, targets[:, :act_dim], targets[:, act_dim:]).mean(1)
    parent_kls = [gaussian_kl(mean, child.log_std, forward(p, obs)[-1], p.log_std).mean(1) for p in parents]
    return expert_reward, student_reward, loss, parent_kls


def crossover(args, round, slots, couples, parents, pools, stats):
    """The children of couples[slot] for the local slots (Section 3.2.1), as policies [children, P] and facts per child.

    parents: policies [m, P] and fitness [m] of the whole population; a child starts as a copy of the stronger parent.
    """
    mine = [couples[slot] for slot in slots]
    stronger = [x if parents.fitness[x] >= parents.fitness[y] else y for x, y in mine]
    children = parents.policies[stronger].clone()
    facts = [{} for _ in slots]
    if args.crossover == "parameter":
        for k, (slot, (x, y)) in enumerate(zip(slots, mine)):
            from_x = torch.from_numpy(rng(args.seed, "parameter", round, slot).random(children.shape[1]) < 0.5)
            children[k] = torch.where(from_x.to(children.device), parents.policies[x], parents.policies[y])
    if args.crossover != "state-space" or mine[0][0] == mine[0][1]:  # a lone healthy member is only copied
        return children, facts, None

    device = children.device
    rows = {couple: selector_data(args, pools, couple, stats) for couple in set(couples)}
    steps = args.pi_s_epochs * math.ceil(max(map(len, rows.values())) / args.crossover_minibatch_size)
    start = time.perf_counter()
    pi_s = train_selector(args, round, slots, [rows[couple] for couple in mine], steps, device)
    middle = time.perf_counter()
    child = make_policy(children, args)
    stacks = [make_policy(parents.policies[[couple[side] for couple in mine]], args) for side in (0, 1)]
    expert_reward, student_reward, loss, parent_kls = distill(args, round, slots, child, pi_s, stacks, stats)
    end = time.perf_counter()
    for k, couple in enumerate(mine):
        row = torch.from_numpy(rows[couple]).to(device)
        net = make_net(pi_s.flat[k : k + 1], pi_s.sizes)
        says_y = forward(net, row[None, :, :-2].mT)[-1][0].argmax(0)
        facts[k] = {
            "pi_s_accuracy": (says_y == row[:, -2:].argmax(1)).float().mean().item(),
            "share_x": (row[:, -2] > 0).float().mean().item(),
            "expert_reward": float(expert_reward[k]),
            "student_reward": float(student_reward[k]),
            "distillation_kl": loss[k].item(),
            "kl_to_parents": [parent_kls[0][k].item(), parent_kls[1][k].item()],
            "seconds": [middle - start, end - middle],
        }
    return children, facts, pi_s.flat


def crossover_steps(args):
    """Environment steps of one round's crossovers of the whole population."""
    if args.crossover != "state-space":
        return 0
    return args.population * (args.expert_steps // 10 * 10 + args.dagger_iterations * args.student_steps)


# ---------------------------------------------------------------- evaluation


def evaluate(args, policy, stats, purpose, episodes, mean_action=False):
    """Raw returns [members, episodes] of complete episodes; all members meet the same starts and the same noise."""
    members, width = len(policy.flat), min(episodes, 20)
    envs = make_envs(args, members * width)
    returns = []
    for chunk in range(math.ceil(episodes / width)):
        obs, _ = envs.reset(seed=env_seeds(width, args.seed, purpose, chunk) * members)
        noise = None
        if not mean_action:
            noise = normal_noise([rng(args.seed, purpose, chunk, 1)], args.max_episode_steps, width, args.act_dim)
        act = sample_actions(policy, stats, noise)
        data = rollout(envs, obs.reshape(members * width, -1), act, args.max_episode_steps)
        in_first_episode = np.cumsum(data.dones, axis=0) - data.dones == 0
        returns.append((data.rewards * in_first_episode).sum(0).reshape(members, width))
    envs.close()
    return np.concatenate(returns, axis=1)[:, :episodes]


def evaluation_cost(args, episodes):
    """Environment steps of one `evaluate` call per member."""
    width = min(episodes, 20)
    return math.ceil(episodes / width) * width * args.max_episode_steps


def final_evaluation(args, policy, stats, ids):
    """Every member plays selection episodes, and report episodes on other seeds; the best is chosen on the first only,
    because the maximum that won a selection is biased upward.
    """
    selection = evaluate(args, policy, stats, "selection", args.selection_episodes)
    report = evaluate(args, policy, stats, "report", args.report_episodes)
    report_mean_action = evaluate(args, policy, stats, "report", args.report_episodes, mean_action=True)
    members = [
        {
            "id": ids[i],
            "selection_return": float(selection[i].mean()),
            "report_return": float(report[i].mean()),
            "report_std": float(report[i].std(ddof=1)) if args.report_episodes > 1 else 0.0,
            "mean_action_return": float(report_mean_action[i].mean()),
        }
        for i in range(len(ids))
    ]
    members = gather(members)
    best = max(range(len(members)), key=lambda i: members[i]["selection_return"])
    returns = [member["report_return"] for member in members]
    steps = len(members) * (evaluation_cost(args, args.selection_episodes) + 2 * evaluation_cost(args, args.report_episodes))
    result = {
        "best": returns[best],
        "best_std": members[best]["report_std"],
        "best_mean_action": members[best]["mean_action_return"],
        "mean": float(np.mean(returns)),
        "best_slot": best,
        "best_id": members[best]["id"],
        "selection_episodes": args.selection_episodes,
        "report_episodes": args.report_episodes,
        "members": members,
    }
    return result, steps


# ---------------------------------------------------------------- workers


def world():
    """(rank, number of workers) of this process."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def gather(values):
    """Lists of one value per local member, joined over all workers in member order."""
    if world()[1] == 1:
        return values
    parts = [None] * world()[1]
    dist.all_gather_object(parts, values)
    return [value for part in parts for value in part]


def gather_rows(stack):
    """The rows of all workers' stacks as one stack on the same device."""
    return torch.from_numpy(np.stack(gather(list(stack.cpu().numpy())))).to(stack.device)


def share(batches):
    """All members' batches, as far as a borrower needs them."""
    names = ("obs", "actions", "advantages", "log_probs")
    shared = gather([{name: getattr(batch, name).cpu().numpy() for name in names} for batch in batches])
    device = batches[0].obs.device
    return [SimpleNamespace(**{name: torch.from_numpy(x).to(device) for name, x in batch.items()}) for batch in shared]


def local_slots(population):
    """The slots of the population that this worker owns; any split will do."""
    rank, workers = world()
    return [int(slot) for slot in np.array_split(np.arange(population), workers)[rank]]


def die_with_parent():
    """Asks Linux to kill this worker when its launcher dies, however that happens; elsewhere this is left out."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def launch(args, argv):
    """Runs this script once per worker through torch's elastic launcher, which restarts the group if a worker crashes."""
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=args.workers,
        run_id=args.run_name,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=args.max_restarts,
        monitor_interval=0.5,
    )
    try:
        elastic_launch(config, sys.executable)(__file__, *argv, "--run-name", args.run_name)
    except SignalException as stop:
        raise SystemExit(128 + stop.sigval.value) from None
    except ChildFailedError as failure:
        codes = sorted({f.exitcode for f in failure.failures.values()})
        if codes == [2]:
            raise SystemExit(2) from None
        print(f"{Path(__file__).name}: error: a worker failed (exit code {codes[0]}); its own error is above", file=sys.stderr)
        raise SystemExit(1) from None


# ---------------------------------------------------------------- a run's folder

PER_MEMBER = "policies critics kl_coefs obs_count obs_mean obs_m2 return_square return_weight ids".split()


def new_population(args, slots):
    """Random policies and critics for the local slots, all statistics empty; every field has one row per member."""
    n = len(slots)
    return SimpleNamespace(
        policies=init_rows([rng(args.seed, "policy", slot) for slot in slots], policy_sizes(args), 0.01, log_std=True),
        critics=init_rows([rng(args.seed, "critic", slot) for slot in slots], critic_sizes(args), 1.0),
        kl_coefs=np.full(n, args.kl_coef),
        obs_count=np.zeros(n),
        obs_mean=np.zeros((n, args.obs_dim)),
        obs_m2=np.zeros((n, args.obs_dim)),
        return_square=np.zeros(n),
        return_weight=np.zeros(n),
        ids=np.array(slots),
    )


def save_atomically(content, path):
    """Writes beside and renames, so that a reader finds the old file or the new one, never half of one."""
    beside = path.with_name(path.name + ".tmp")
    with open(beside, "wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)


def save_checkpoint(args, folder, population, progress):
    """Everything that the rest of the run depends on, as tensors and plain values; all workers call, rank 0 writes."""
    stacks = {name: gather_rows(torch.as_tensor(getattr(population, name))).cpu() for name in PER_MEMBER}
    if world()[0] == 0:
        save_atomically({"format": 1, "args": args.flags, "population": stacks, "progress": progress}, folder / "checkpoint.pt")


def load_checkpoint(folder):
    """The checkpoint of a run's folder; refuses what is not one."""
    path = Path(folder) / "checkpoint.pt"
    if not path.is_file():
        refuse(f"--resume {folder}: there is no {path.name} in this folder")
    try:
        checkpoint = torch.load(path, weights_only=True)
        if checkpoint["format"] != 1 or checkpoint["args"]["exp_name"] is None:
            raise ValueError("unknown format")
        return checkpoint
    except Exception as error:
        refuse(f"--resume {folder}: {path.name} cannot be read as a checkpoint ({type(error).__name__})")


def own_rows(stacks, slots):
    """The local members' part of a checkpoint's population."""
    rows = {name: stack[slots].clone() for name, stack in stacks.items()}
    return SimpleNamespace(**{name: x if name in ("policies", "critics") else x.numpy() for name, x in rows.items()})


def lock_folder(folder):
    """Holds the folder for this process, so that a run which is still alive is not resumed a second time."""
    handle = open(folder / ".lock", "w")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        refuse(f"{folder}: a live run holds this folder; wait for its end or stop it first")
    return handle


def make_logger(args, folder, progress):
    """log(scalars, step) for TensorBoard and, with --track, W&B; both get one monotone step, the total of env steps."""
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(folder, purge_step=progress["global_step"] + 1 if progress["global_step"] else None)
    writer.add_text("hyperparameters", "|param|value|\n|-|-|\n" + "\n".join(f"|{k}|{v}|" for k, v in args.flags.items()))
    if args.track:
        import wandb

        wandb.init(
            project=args.wandb_project_name,
            entity=args.wandb_entity,
            name=folder.name,
            id=folder.name,
            resume="allow",
            config=args.flags,
            save_code=True,
        )

    def log(scalars, step):
        for name, value in scalars.items():
            writer.add_scalar(name, value, step)
        writer.flush()
        if args.track:
            wandb.log({**scalars, "global_step": step}, step=step)

    return log


def make_progress(args, step):
    """show(step, text): one bar on a terminal, plain lines (at most one in ten seconds) elsewhere."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        bar = tqdm(total=args.total_timesteps, initial=step, unit="step", unit_scale=True, dynamic_ncols=True)

        def show(step, text, always=False):
            bar.set_postfix_str(text, refresh=False)
            bar.update(step - bar.n)

        return show
    start, last = (time.time(), step), [0.0]

    def show(step, text, always=False):
        if always or time.time() - last[0] > 10:
            last[0] = time.time()
            left = (args.total_timesteps - step) * (time.time() - start[0]) / max(step - start[1], 1)
            print(f"{step}/{args.total_timesteps} steps, {text}, {left / 60:.1f} min left", flush=True)

    return show


def library_versions():
    names = ("torch", "gymnasium", "mujoco", "numpy", "tyro", "tensorboard", "wandb")
    return {"python": sys.version.split()[0], **{name: version(name) for name in names}}


def save_policy(args, folder, result, policy, mean, inv_std):
    """policy.pt: the best member with its normalizer, and what is needed to play it."""
    content = {
        "format": 1,
        "policy": torch.from_numpy(policy),
        "sizes": list(policy_sizes(args)),
        "obs_mean": torch.from_numpy(mean),
        "obs_inv_std": torch.from_numpy(inv_std),
        "args": args.flags,
        "max_episode_steps": args.max_episode_steps,
        "id": result["best_id"],
        "report_return": result["best"],
    }
    save_atomically(content, folder / "policy.pt")


def save_crossover(args, folder, round, couples, ids, parents, children, pi_s, stats):
    """crossover_NNN.pt: a round's parents, children, pi_S and normalizer."""
    content = {
        "format": 1,
        "args": args.flags,
        "max_episode_steps": args.max_episode_steps,
        "round": round + 1,
        "couples": couples,
        "ids": ids,
        "fitness": torch.from_numpy(parents.fitness),
        "parents": parents.policies.cpu(),
        "children": children.cpu(),
        "pi_s": None if pi_s is None else pi_s.cpu(),
        "obs_mean": torch.from_numpy(stats.mean[0]),
        "obs_inv_std": torch.from_numpy(stats.inv_std[0]),
    }
    save_atomically(content, folder / f"crossover_{round + 1:03d}.pt")


# ---------------------------------------------------------------- what one sees


def gaussian_entropy(log_std):
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum().item()


def explained_variance(values, returns):
    variance = returns.var()
    return 1 - (returns - values).var() / variance if variance > 0 else float("nan")


def iteration_scalars(args, facts, progress, seconds):
    """What is logged after each iteration; facts: one dict per member of the whole population."""
    episodes = [episode for fact in facts for episode in fact["episodes"]]
    member_returns = [np.mean([ret for ret, _ in fact["episodes"]]) for fact in facts if fact["episodes"]]
    scalars = {f"losses/{name}": float(np.mean([f["losses"][name] for f in facts])) for name in facts[0]["losses"]}
    if episodes:
        scalars["charts/episodic_return"] = float(np.mean([ret for ret, _ in episodes]))
        scalars["charts/episodic_length"] = float(np.mean([length for _, length in episodes]))
        scalars["population/best_return"] = float(np.max(member_returns))
        scalars["population/mean_return"] = float(np.mean(member_returns))
        scalars["population/min_return"] = float(np.min(member_returns))
        scalars["population/std_return"] = float(np.std(member_returns))
    for slot, fact in enumerate(facts):
        if fact["episodes"]:
            scalars[f"population/return_{slot}"] = float(np.mean([ret for ret, _ in fact["episodes"]]))
        scalars[f"sharing/size_{slot}"] = fact["sharing"]
    scalars["sharing/mean_size"] = float(np.mean([fact["sharing"] for fact in facts]))
    scalars["population/round"] = progress["round"] + 1
    scalars["charts/learning_rate"] = args.learning_rate
    scalars["charts/SPS"] = progress["global_step"] / progress["seconds"]
    phases = ("rollout", "advantages", "sharing", "policy_update", "critic_update")
    return {**scalars, **{f"time/{phase}": float(s) for phase, s in zip(phases, seconds)}}


def crossover_scalars(args, lines, kl, seconds):
    """What is logged after each crossover; lines: the round's part of lineage.jsonl."""
    child = np.array([line["child_return"] for line in lines])
    parents = np.array([line["parent_returns"] for line in lines])
    names = ("pi_s_accuracy", "share_x", "expert_reward", "student_reward", "distillation_kl")
    scalars = {f"crossover/{name}": float(np.mean([line[name] for line in lines])) for name in names if name in lines[0]}
    if "kl_to_parents" in lines[0]:
        scalars["crossover/kl_to_parents"] = float(np.mean([line["kl_to_parents"] for line in lines]))
    scalars["crossover/child_return"] = float(child.mean())
    scalars["crossover/parent_return"] = float(parents.mean())
    scalars["crossover/child_minus_best_parent"] = float((child - parents.max(1)).mean())
    scalars["population/diversity"] = float((kl.sum() - np.trace(kl)) / max(kl.size - len(kl), 1))
    phases = ("select", "pi_s", "dagger", "comparison")
    return {**scalars, **{f"time/{phase}": float(s) for phase, s in zip(phases, seconds)}}


def progress_text(round, rounds, scalars):
    best, mean = (scalars.get(f"population/{name}_return", float("nan")) for name in ("best", "mean"))
    return f"round {round + 1}/{rounds}, best {best:.0f}, mean {mean:.0f}, {scalars['charts/SPS']:.0f} SPS"


def crossover_text(round, rounds, scalars):
    child, parent = scalars["crossover/child_return"], scalars["crossover/parent_return"]
    return f"round {round + 1}/{rounds} crossed over: children {child:.0f}, their parents {parent:.0f}"

# ---------------------------------------------------------------- the run


def iterations_per_round(args):
    """Iterations of mutation in each round; the first rounds get one more where they do not divide evenly.

    As many rounds as fit into the budget, each with its crossovers; refuses a budget that not even one fits into.
    """
    iteration = args.population * args.num_envs * args.num_steps
    smallest = iteration + crossover_steps(args)
    rounds = min(args.rounds, args.total_timesteps // smallest)
    if rounds == 0:
        refuse(f"--total-timesteps {args.total_timesteps}: one round takes {smallest} steps; give at least that")
    iterations = (args.total_timesteps - rounds * crossover_steps(args)) // iteration
    return [iterations // rounds + (k < iterations % rounds) for k in range(rounds)]


@torch.no_grad()
def train(args):
    """One worker's part of a whole run."""
    rank, workers = world()
    m, slots = args.population, local_slots(args.population)
    n = len(slots)
    device = torch.device("cuda", rank % torch.cuda.device_count()) if args.cuda else torch.device("cpu")
    folder = Path(args.run_dir) / args.run_name
    checkpoint = load_checkpoint(folder) if args.resume else None
    if checkpoint:
        population, progress = own_rows(checkpoint["population"], slots), checkpoint["progress"]
    else:
        population = new_population(args, slots)
        progress = {"round": 0, "global_step": 0, "evaluation_steps": 0, "lineage_bytes": 0, "seconds": 0.0}
    population.policies, population.critics = population.policies.to(device), population.critics.to(device)
    plan = iterations_per_round(args)
    start = time.perf_counter() - progress["seconds"]

    if rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        lock = lock_folder(folder)  # noqa: F841  held until the process ends
        log, show = make_logger(args, folder, progress), make_progress(args, progress["global_step"])
        (folder / "args.json").write_text(json.dumps({**args.flags, "versions": library_versions()}, indent=1) + "\n")
        os.truncate((folder / "lineage.jsonl").open("a").name, progress["lineage_bytes"])
        steps = sum(plan) * m * args.num_envs * args.num_steps + len(plan) * crossover_steps(args)
        print(
            f"{folder}: {m} members on {workers} worker(s), {len(plan)} rounds of {plan[0]} iterations, horizon"
            f" {args.max_episode_steps}; {steps} of {args.total_timesteps} steps ({steps // m} per member)",
            flush=True,
        )
    else:
        log = show = lambda *_, **__: None
    if not checkpoint:
        save_checkpoint(args, folder, population, progress)

    envs = make_envs(args, n * args.num_envs)
    for round in range(progress["round"], len(plan)):
        # Everything starts afresh here: environments, optimizers, open episodes. A checkpoint needs none of them.
        policy, critic = make_policy(population.policies, args), make_net(population.critics, critic_sizes(args))
        policy_optimizer, critic_optimizer = adam(policy, args.learning_rate), adam(critic, args.critic_learning_rate)
        obs, _ = envs.reset(seed=[s for slot in slots for s in env_seeds(args.num_envs, args.seed, "reset", round, slot)])
        obs = obs.reshape(n * args.num_envs, -1)
        open_episodes = [[] for _ in obs]
        pools, recent = [deque() for _ in slots], [deque(maxlen=2) for _ in slots]
        diverged = np.zeros(n, bool)
        warmup = min(args.critic_warmup, plan[round] - 1) if round > 0 else 0

        for iteration in range(plan[round]):
            clock = [time.perf_counter()]
            stats = statistics(population)
            generators = [rng(args.seed, "noise", round, iteration, slot) for slot in slots]
            noise = normal_noise(generators, args.num_steps, args.num_envs, args.act_dim)
            data = rollout(envs, obs, sample_actions(policy, stats, noise), args.num_steps)
            obs = data.last_obs
            diverged |= data.diverged.reshape(n, -1).any(1)
            finished = finished_episodes(open_episodes, data)
            episodes = [[x for e in range(args.num_envs) for x in finished[i * args.num_envs + e]] for i in range(n)]
            for i in range(n):
                recent[i].append([ret for _, ret in episodes[i]])
                pools[i].extend(episodes[i])
                while sum(len(obs) for obs, _ in pools[i]) - len(pools[i][0][0] if pools[i] else ()) >= args.crossover_pool:
                    pools[i].popleft()
            clock.append(time.perf_counter())

            batches, critic_obs, values, returns = make_batches(args, data, policy, critic, stats)
            if iteration == 0:
                # S_i (Section 3.2.2) without i. NaN compares false: nobody borrows from a broken member.
                everyone = gather_rows(population.policies)
                kl = [kl_row(policy.rows[i], batches[i].obs, everyone, args) for i in range(n)]
                similar = [np.flatnonzero(kl[i] < args.kl_sharing_threshold) for i in range(n)]
                similar = [[j for j in similar[i] if j != slots[i]] if args.data_sharing else [] for i in range(n)]
            clock.append(time.perf_counter())
            learning = iteration >= warmup
            shared = share(batches) if args.data_sharing and learning else []
            clock.append(time.perf_counter())
            losses, kls = [0.0] * n, [0.0] * n
            if learning:
                borrowed = [[shared[j] for j in similar[i]] for i in range(n)]
                losses, kls = update_policies(args, policy, policy_optimizer, batches, borrowed, population.kl_coefs)
            clock.append(time.perf_counter())

            raw_obs = by_member(data.obs, n)
            facts = gather(
                [
                    {
                        "episodes": [(ret, len(obs)) for obs, ret in episodes[i]],
                        "moments": batch_moments(raw_obs[i]),
                        "mean_square": np.square(returns[i]).mean(),
                        "sharing": len(similar[i]) + 1,
                        "losses": {
                            "policy_loss": losses[i],
                            "value_loss": 0.5 * np.square(values[i] - returns[i]).mean(),
                            "approx_kl": kls[i],
                            "entropy": gaussian_entropy(policy.rows[i].log_std),
                            "explained_variance": explained_variance(values[i], returns[i]),
                            "kl_coef": population.kl_coefs[i],
                        },
                    }
                    for i in range(n)
                ]
            )
            for i in range(n):
                moments, squares = [fact["moments"] for fact in facts], [fact["mean_square"] for fact in facts]
                update_statistics(args, population, i, moments, squares)
            targets = returns / statistics(population).return_rms[:, None]
            generators = [rng(args.seed, "critic_shuffle", round, iteration, slot) for slot in slots]
            update_critics(args, critic, critic_optimizer, critic_obs, targets, generators)
            clock.append(time.perf_counter())

            progress["global_step"] += m * args.num_envs * args.num_steps
            progress["seconds"] = time.perf_counter() - start
            scalars = iteration_scalars(args, facts, progress, np.diff(clock))
            log(scalars, progress["global_step"])
            show(progress["global_step"], progress_text(round, len(plan), scalars))

        for i in range(n):
            if not any(recent[i]):  # nothing ended in the last two iterations: the last that did, else what is open
                recent[i].append([ret for _, ret in pools[i]][-1:])
            if not pools[i]:
                open_pieces = [p for p in open_episodes[i * args.num_envs : (i + 1) * args.num_envs] if p]
                pools[i].extend((np.concatenate([x[0] for x in p]), float(sum(x[1] for x in p))) for p in open_pieces)
                recent[i].append([ret for _, ret in pools[i]])
        fitness = [float(np.mean([r for returns in recent[i] for r in returns])) for i in range(n)]
        healthy = [not diverged[i] and policy.flat[i].isfinite().all() and critic.flat[i].isfinite().all() for i in range(n)]
        fitness = np.array(gather([f if ok else math.nan for f, ok in zip(fitness, healthy)]))
        scalars = breed(args, folder, round, slots, population, progress, policy, batches, fitness, pools)
        log(scalars, progress["global_step"])
        progress["round"] += 1
        progress["seconds"] = time.perf_counter() - start
        save_checkpoint(args, folder, population, progress)
        show(progress["global_step"], crossover_text(round, len(plan), scalars), always=True)
    envs.close()

    stats, policy = statistics(population), make_policy(population.policies, args)
    result, steps = final_evaluation(args, policy, stats, [int(i) for i in population.ids])
    progress["evaluation_steps"] += steps
    result = {"global_step": progress["global_step"], "evaluation_steps": progress["evaluation_steps"], **result}
    best = gather([(policy.flat[i].cpu().numpy(), stats.mean[i], stats.inv_std[i]) for i in range(n)])[result["best_slot"]]
    if rank == 0:
        save_policy(args, folder, result, *best)
        (folder / "evaluation.json").write_text(json.dumps(result, indent=1) + "\n")
        log({"eval/episodic_return": result["best"], "eval/mean_return": result["mean"]}, progress["global_step"])
        print(
            f"best {result['best']:.1f} +- {result['best_std']:.1f} (member {result['best_id']}), mean of the population"
            f" {result['mean']:.1f}, over {args.report_episodes} episodes each; {progress['global_step']} steps"
            f" in {(time.perf_counter() - start) / 60:.1f} min; everything is in {folder}",
            flush=True,
        )
    return result


def breed(args, folder, round, slots, population, progress, policy, batches, fitness, pools):
    """Ends a round: select, crossover, comparison of children with parents; replaces the population's members in place.

    Returns the scalars to log. fitness [m] of everyone, NaN where a member must not breed.
    """
    start = time.perf_counter()
    parents = SimpleNamespace(policies=gather_rows(population.policies), fitness=fitness)
    kl = np.stack(gather([kl_row(row, batch.obs, parents.policies, args) for row, batch in zip(policy.rows, batches)]))
    couples = select(args, round, fitness, kl)
    selected = time.perf_counter()

    stats, pools = statistics(population), gather(pools)
    children, facts, pi_s = crossover(args, round, slots, couples, parents, pools, stats)
    crossed = time.perf_counter()

    purpose = f"comparison {round}"
    parent_returns = gather(list(evaluate(args, make_policy(population.policies, args), stats, purpose, args.comparison_episodes)))
    child_returns = gather(list(evaluate(args, make_policy(children, args), stats, purpose, args.comparison_episodes)))
    facts = gather(facts)
    critics, kl_coefs = gather_rows(population.critics), gather(list(population.kl_coefs))
    ids = gather([int(i) for i in population.ids])
    strongest = [max(couple, key=lambda i: fitness[i]) for couple in couples]
    population.policies = children
    population.critics = critics[[strongest[slot] for slot in slots]]
    population.kl_coefs = np.array([kl_coefs[strongest[slot]] for slot in slots])
    population.ids = np.array([args.population * (round + 1) + slot for slot in slots])
    progress["global_step"] += crossover_steps(args)
    progress["evaluation_steps"] += 2 * args.population * evaluation_cost(args, args.comparison_episodes)

    all_children, all_pi_s = gather_rows(children), gather_rows(pi_s) if pi_s is not None else None
    lines = [
        {
            "id": args.population * (round + 1) + slot,
            "round": round + 1,
            "slot": slot,
            "global_step": progress["global_step"],
            "parents": [ids[i] for i in couples[slot]],
            "parent_fitness": [float(fitness[i]) for i in couples[slot]],
            "parent_returns": [float(parent_returns[i].mean()) for i in couples[slot]],
            "child_return": float(child_returns[slot].mean()),
            **{name: value for name, value in facts[slot].items() if name != "seconds"},
        }
        for slot in range(args.population)
    ]
    if world()[0] == 0:
        with open(folder / "lineage.jsonl", "a") as lineage:
            lineage.writelines(json.dumps(line) + "\n" for line in lines)
            lineage.flush()
            os.fsync(lineage.fileno())
            progress["lineage_bytes"] = lineage.tell()
        if round == 0 or args.save_crossovers:
            save_crossover(args, folder, round, couples, ids, parents, all_children, all_pi_s, stats)
    seconds = [selected - start, *np.max([f.get("seconds", [0.0, 0.0]) for f in facts], axis=0)]
    return crossover_scalars(args, lines, kl, [*seconds, time.perf_counter() - crossed])


def check_args(args):
    """Refuses what cannot run, and adds what follows from flags and environment: obs_dim, act_dim, the horizon."""
    positive = "num_envs num_steps total_timesteps rounds learning_rate critic_learning_rate update_epochs kl_target critic_epochs"
    positive += " critic_minibatch_size crossover_pool crossover_learning_rate crossover_minibatch_size pi_s_epochs dagger_epochs"
    positive += " comparison_episodes selection_episodes report_episodes student_steps importance_clip"
    for name in positive.split():
        if not getattr(args, name) > 0:
            refuse(f"--{name.replace('_', '-')} {getattr(args, name)}: must be greater than 0")
    for name in "seed kl_hinge kl_coef kl_sharing_threshold critic_warmup max_restarts dagger_iterations".split():
        if not getattr(args, name) >= 0:
            refuse(f"--{name.replace('_', '-')} {getattr(args, name)}: must not be negative")
    for name in ("gamma", "gae_lambda", "crossover_top", "diversity_weight"):
        if not 0 <= getattr(args, name) <= 1:
            refuse(f"--{name.replace('_', '-')} {getattr(args, name)}: must lie between 0 and 1")
    if args.expert_steps < 10:
        refuse(f"--expert-steps {args.expert_steps}: must be at least 10, one step in each of ten environments")
    if args.population < 2:
        refuse(f"--population {args.population}: a couple needs at least 2 members; for one policy see joint_baseline.py")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    args.workers = args.workers or min(cores, args.population)
    if not 1 <= args.workers <= args.population:
        refuse(f"--workers {args.workers}: must lie between 1 and --population {args.population}")
    if args.cuda and not torch.cuda.is_available():
        refuse("--cuda: PyTorch sees no CUDA device here; leave the flag out to run on the CPU")
    check_environment(args)
    iterations_per_round(args)
    try:
        Path(args.run_dir).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        refuse(f"--run-dir {args.run_dir}: {error.strerror}")
    if not os.access(args.run_dir, os.W_OK):
        refuse(f"--run-dir {args.run_dir}: this folder cannot be written to")


def check_environment(args):
    """Makes the environment once: refuses what a Gaussian policy cannot play, and sets obs_dim, act_dim, the horizon."""
    try:
        json_object = isinstance(json.loads(args.env_kwargs), dict)
    except ValueError:
        json_object = False
    if not json_object:
        refuse(f"--env-kwargs {args.env_kwargs!r}: must be a JSON object, such as '{{\"difficulty\": 0.5}}'")
    if args.max_episode_steps is not None and args.max_episode_steps < 1:
        refuse(f"--max-episode-steps {args.max_episode_steps}: must be greater than 0")
    try:
        own_limit = gym.spec(args.env_id).max_episode_steps
        args.max_episode_steps = args.max_episode_steps or min(512, own_limit or 512)
        envs = make_envs(args, 1)
    except Exception as error:  # whatever an environment's constructor raises is about the id or its keywords
        refuse(f"--env-id {args.env_id} --env-kwargs '{args.env_kwargs}': {' '.join(str(error).split())}")
    for name, space in (("action", envs.single_action_space), ("observation", envs.single_observation_space)):
        if not isinstance(space, gym.spaces.Box):
            refuse(f"--env-id {args.env_id}: its {name} space is {space}; only Box is supported")
    args.obs_dim = math.prod(envs.single_observation_space.shape)
    args.act_dim = math.prod(envs.single_action_space.shape)
    envs.close()


MAY_CHANGE = {"workers", "max_restarts", "cuda", "run_dir", "run_name", "resume", "track", "wandb_project_name", "wandb_entity"}


def parse_args(argv):
    """The flags, checked, in one namespace; those of a resumed run come from its checkpoint."""
    cli = dict(args=argv, description=__doc__, config=(tyro.conf.OmitArgPrefixes,))
    args = flatten(tyro.cli(Args, **cli))
    if args.resume:
        stored = load_checkpoint(args.resume)["args"]
        args = flatten(tyro.cli(Args, default=unflatten(stored), **cli))
        for name, value in vars(args).items():
            if name not in MAY_CHANGE and value != stored[name]:
                refuse(f"--{name.replace('_', '-')} {value}: the run was started with {stored[name]}; this cannot change")
        folder = Path(args.resume).absolute()
        args.run_dir, args.run_name = str(folder.parent), folder.name
    args.flags = dict(vars(args), resume=None)
    check_args(args)
    if not args.run_name:
        env_name = args.env_id.replace("/", "-").replace(":", "-")
        args.run_name = f"{env_name}__{args.exp_name}__{args.seed}__{int(time.time())}"
    return args


def main(argv=None):
    """Trains, on one worker in this process, on more through torch's launcher; returns the content of evaluation.json."""
    argv = sys.argv[1:] if argv is None else argv
    args = parse_args(argv)
    if "TORCHELASTIC_RUN_ID" in os.environ:
        die_with_parent()
        torch.set_num_threads(1)
        dist.init_process_group("gloo")
        if (Path(args.run_dir) / args.run_name / "checkpoint.pt").exists():
            args.resume = str(Path(args.run_dir) / args.run_name)
        result = train(args)
        dist.destroy_process_group()
        return result
    if args.workers > 1:
        return launch(args, argv)
    torch.set_num_threads(1)
    return train(args)


if __name__ == "__main__":
    main()
